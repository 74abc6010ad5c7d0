"""`python -m hearthlog.tools.lab.pictures`: the pictures of docs, from a simulated home."""

import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from PIL import Image

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.pictures.browser import Browser
from hearthlog.tools.lab.pictures.content import content_of
from hearthlog.tools.lab.pictures.home import DAY, EVENING, NOW, ZONE, Home, compose_home
from hearthlog.tools.lab.pictures.pages import served_page, write_report
from hearthlog.tools.lab.pictures.timelines import day_picture, queue_picture

ROOT = Path(__file__).resolve().parents[3]
FOLDER = Path("docs/images")
_RECORD = "pictures.json"
_CONTENT = {  # what each picture shows, of `content_of`
    "review-day.png": "review",
    "first-evening-review.png": "review",
    "first-evening-queue.png": "queue",
    "first-evening-report.png": "report",
    "home-page.png": "page",
}
_DESK, _PHONE = (1366, 768), (390, 844)
_TOP_BAR = 36  # pixels of the viewer's own menu
_COLOURS = 128  # half a palette
_BETWEEN = 20  # pixels between pictures of a phone
_GREY = (128, 128, 128)


def pictures(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the pictures.")
    ] = FOLDER,
    home: Annotated[
        Path | None, typer.Option(help="New folder to keep the home in, or one that has it.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="Such as home-page.png.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only say which pictures show an earlier program.")
    ] = False,
) -> None:
    """Make the pictures of docs, and record what they show."""
    if check:
        if lines := outdated(ROOT):
            raise HearthlogError("\n".join(lines))
        return
    names = only or list(_CONTENT)
    if unknown := set(names) - set(_CONTENT):
        raise HearthlogError(f"{', '.join(unknown)}: there is {', '.join(_CONTENT)}")
    with TemporaryDirectory() as folder:
        place = home or Path(folder, "home")
        own = Home(place / "logs", place / "evening")
        if not own.evening.exists():
            print("composing the home, about three minutes", file=sys.stderr)
            own = compose_home(place)
        for name in names:
            print(name, file=sys.stderr)
            _save(_MAKE[name](own), output / name)
    record, now = output / _RECORD, content_of(ROOT)
    known = json.loads(record.read_text("utf-8")) if record.exists() else {}
    known |= {name: now[_CONTENT[name]] for name in names}
    record.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n", "utf-8")


def outdated(root: Path) -> list[str]:
    """Return a line for each picture of a clone that shows an earlier program."""
    known = json.loads((root / FOLDER / _RECORD).read_text("utf-8"))
    now = content_of(root)
    return [
        f"{FOLDER / name} shows an earlier program: run `make pictures`"
        for name, kind in _CONTENT.items()
        if known.get(name) != now[kind]
    ]


def _day(home: Home) -> Image.Image:
    image = _without_menu(day_picture(home.logs, DAY, _DESK))
    return image.crop((0, 0, image.width, image.height - _DESK[1] // 4))  # without the time panel


def _evening(home: Home) -> Image.Image:
    return _without_menu(day_picture(home.evening, EVENING, _DESK))


def _queue(home: Home) -> Image.Image:
    return _without_menu(queue_picture(home.evening, _DESK))


def _without_menu(picture: bytes) -> Image.Image:
    image = Image.open(io.BytesIO(picture))
    return image.crop((0, _TOP_BAR, *image.size))


def _report(home: Home) -> Image.Image:
    with TemporaryDirectory() as folder, Browser(Path(folder, "browser")) as browser:
        page = Path(folder, "report.html")
        write_report(home.evening, ZONE, local_time(EVENING[0], ZONE).date(), page)
        browser.open(page.as_uri(), *_DESK)
        return Image.open(io.BytesIO(browser.picture()))


def _page(home: Home) -> Image.Image:
    with (
        TemporaryDirectory() as folder,
        Browser(Path(folder, "browser")) as browser,
        served_page(home.logs, ZONE, NOW) as page,
    ):

        def show(language: str, *, dark: bool = False) -> None:
            browser.open(page.address, *_PHONE, dark=dark, language=language)
            browser.wait_for('document.querySelectorAll("#events li, .lane").length > 4')
            browser.wait_for('document.querySelectorAll("#dates option").length > 1')

        show("en")
        seen = [browser.picture()]
        browser.evaluate('document.getElementById("looked-at").scrollIntoView()')
        seen.append(browser.picture())
        show("de", dark=True)
        browser.evaluate('document.getElementById("day-before").click()')
        browser.wait_for(
            'document.getElementById("day-sentence").dataset.date'
            ' === document.getElementById("dates").options[1].value'
        )
        seen.insert(1, browser.picture())
    width, height = _PHONE
    whole = Image.new("RGB", (len(seen) * (width + _BETWEEN) - _BETWEEN, height), _GREY)
    for number, picture in enumerate(seen):
        whole.paste(Image.open(io.BytesIO(picture)), (number * (width + _BETWEEN), 0))
    return whole


def _save(image: Image.Image, path: Path) -> None:
    """Write a small PNG, in which areas keep their colours.

    Half of its palette are the most frequent colours, and half those closest to the others.
    """
    image = image.convert("RGB")
    counts = image.getcolors(image.width * image.height)
    often = [value for _, colour in sorted(counts, reverse=True)[:_COLOURS] for value in colour]
    others = image.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE).getpalette()
    palette = Image.new("P", (1, 1))
    palette.putpalette(often + others[: 3 * _COLOURS])
    path.parent.mkdir(parents=True, exist_ok=True)
    image.quantize(palette=palette, dither=Image.Dither.NONE).save(path, optimize=True)


_MAKE: dict[str, Callable[[Home], Image.Image]] = {
    "review-day.png": _day,
    "first-evening-review.png": _evening,
    "first-evening-queue.png": _queue,
    "first-evening-report.png": _report,
    "home-page.png": _page,
}


if __name__ == "__main__":
    run(pictures)
