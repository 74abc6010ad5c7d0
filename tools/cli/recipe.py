"""The way to learn that the user chose."""

from typing import TYPE_CHECKING

from hearthlog.tools.cli.selection import wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.recipe import Recipe


def chosen_recipe(method: str, cost: float | None = None, gamma: float | None = None) -> "Recipe":
    """Return a recipe, with another cost and gamma if they are given."""
    from hearthlog.analyzer.recipe import RECIPES

    if method not in RECIPES:
        wrong_use(f"--method {method}: choose one of {', '.join(RECIPES)}")
    recipe = RECIPES[method]
    for name, value in (("cost", cost), ("gamma", gamma)):
        if value is not None and not 0 < value < float("inf"):
            wrong_use(f"--{name} {value:g}: it must be more than 0")
    return recipe._replace(cost=cost or recipe.cost, gamma=gamma or recipe.gamma)
