"""Train two ways and compare them: python train_and_compare.py LEARN.csv TEST.csv bathroom."""

import sys

import hearthlog


def main(learn: str, test: str, scenario: str) -> None:
    """Print how good each model is, and which of them is better on clips new to both."""
    models = {method: hearthlog.train(learn, scenario, method) for method in ("paper", "bands")}
    for method, model in models.items():
        print(f"{method:6} macro F1 {model.description.metrics.macro_f1:.3f}, cross-validated")
    result = hearthlog.compare(models["paper"], models["bands"], test)
    difference, interval = result.difference.macro_f1, result.difference.interval
    print(f"bands - paper: {difference:+.3f}, 95 % {interval}, clear: {result.clear}")
    best = max(models, key=lambda name: models[name].description.metrics.macro_f1)
    hearthlog.save_model(models[best], f"{best}.safetensors")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except hearthlog.HearthlogError as error:
        sys.exit(str(error))
