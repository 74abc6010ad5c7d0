"""What is built: the sdist has all that its tests need, the wheel one name and no benchmarks."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections import Counter
from importlib.metadata import packages_distributions
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("analyzer", "models", "recorder", "schemas", "tools")
PACKAGE = PurePosixPath("tools/package/hearthlog")
DATA = {"page.html", "page.css", "page.js", "voice_space.safetensors"}
# Measured, or built, by itself.
APART = {("tools", name) for name in ("deb", "home-assistant", "image", "lab", "ros")}
CLIPS = PurePosixPath("tools/home/clips")
STARTERS = "models/starter"
EMBEDDING = "models/embedding"
PAGE = "analyzer/bridge/page"
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT = CONFIGURATION["project"]


def installed_as(path):
    """Name what a file of the checkout is in the wheel, or None."""
    path = PurePosixPath(path)
    if path.parts[0] not in FOLDERS or path.parts[:2] in APART:
        return None
    if path.parts[:2] == ("tools", "package"):
        own = path.is_relative_to(PACKAGE)
        return f"hearthlog/{path.relative_to(PACKAGE)}" if own else None
    kept = path.name in DATA or any(map(path.is_relative_to, (CLIPS, STARTERS, EMBEDDING, PAGE)))
    if path.suffix not in {".py", ".msg", ".toml", ".service"} and not kept:
        return None
    return f"hearthlog/{path}"


def build(kind, source, folder):
    code = f"from hatchling import build; print(build.build_{kind}({str(folder)!r}))"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return folder / result.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def tracked():
    if not (ROOT / ".git").exists():
        pytest.skip("an sdist is built from a checkout")
    command = ["git", "-c", "safe.directory=*", "-C", ROOT, "ls-files", "-z"]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\0")
    return {name for name in names if name and (ROOT / name).exists()}


LITTER = (
    *("tests/typescript/node_modules/a/b.js", "tests/__pycache__/c.pyc", "demo/day.rrd"),
    *("models/home-1.safetensors", "models/champion.safetensors", "models/.champion.json"),
    *("models/history", "models/.history.0.tmp", "models/judgements/a.json"),
    *("models/old/home-0.safetensors", "ten.txt", "logs/a.mcap"),
)


def litter(checkout):
    """Leave what somebody makes who works there, and ignore none of it."""
    for name in LITTER:
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).touch()
    (checkout / ".gitignore").write_text("")


@pytest.fixture(scope="module")
def sdist(tracked, tmp_path_factory):
    """The sdist, unpacked, of a checkout in which somebody has worked."""
    folder = tmp_path_factory.mktemp("sdist")
    for name in tracked:
        target = folder / "checkout" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target)
    litter(folder / "checkout")
    archive = build("sdist", folder / "checkout", folder)
    subprocess.run(["tar", "-xf", archive, "-C", folder], check=True)
    return folder / archive.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """The wheel, unpacked, that is built from the sdist, in which somebody has worked."""
    folder = tmp_path_factory.mktemp("wheel")
    litter(shutil.copytree(sdist, folder / "source"))
    with zipfile.ZipFile(build("wheel", folder / "source", folder)) as file:
        file.extractall(folder / "wheel")
    return folder / "wheel"


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_every_folder_with_code_is_a_package_but_what_stands_apart():
    every = {path.parent for name in FOLDERS for path in (ROOT / name).rglob("*.py")}
    apart = APART | {("tools", "package")}
    inside = {folder for folder in every if folder.relative_to(ROOT).parts[:2] not in apart}
    assert {folder for folder in inside if not (folder / "__init__.py").exists()} == set()


def test_the_sdist_holds_what_its_tests_need_and_no_litter(sdist, tracked):
    assert files(sdist) - {"PKG-INFO"} == tracked


def test_the_wheel_holds_one_name_and_all_that_is_under_it(wheel, tracked):
    assert len(list(wheel.glob("*.dist-info"))) == 1
    names = {name for name in files(wheel) if ".dist-info/" not in name}
    assert names == {installed_as(name) for name in tracked} - {None}


def test_the_modules_of_the_wheel_find_each_other_under_its_name_alone(wheel, tmp_path):
    code = (
        "import importlib, pkgutil, sys, hearthlog\n"
        "for module in pkgutil.walk_packages(hearthlog.__path__, 'hearthlog.'):\n"
        "    importlib.import_module(module.name)\n"
        "for name, module in sys.modules.items():\n"
        "    if name.partition('.')[0] == 'hearthlog':\n"
        "        print(module.__file__)\n"
    )
    result = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(wheel)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert set(result.stdout.splitlines()) == {str(path) for path in wheel.rglob("*.py")}


def test_a_script_beside_a_clone_that_is_named_hearthlog_imports_the_package(
    sdist, tmp_path, tmp_path_factory
):
    clone = shutil.copytree(sdist, tmp_path / "hearthlog")
    with zipfile.ZipFile(build("editable", clone, tmp_path_factory.mktemp("editable"))) as file:
        (pth,) = (name for name in file.namelist() if name.endswith(".pth"))
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "e"], check=True)
        (site,) = tmp_path.glob("e/lib/python*/site-packages")
        file.extract(pth, site)
    (clone / "analyzer/later").mkdir()  # by `git pull`
    (clone / "analyzer/later/__init__.py").touch()
    (tmp_path / "snip.py").write_text(
        "import hearthlog, hearthlog.analyzer.later\n"
        "print(issubclass(hearthlog.HearthlogError, Exception), hearthlog.__version__)\n"
    )
    result = subprocess.run(
        [tmp_path / "e/bin/python", "snip.py"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (result.stderr, result.stdout.split()[0]) == ("", "True")


BOX = ("schemas", "models", "recorder")
EXTRAS = ("headless", "viewer", "foxglove", "bridge", "cluster")


def requested_for(*extras):
    """Name the distributions that hearthlog needs itself, with some extras."""
    texts = list(PROJECT["dependencies"])
    for extra in extras:
        texts += PROJECT["optional-dependencies"][extra]
    return {normal(re.match(r"[\w.-]+", text)[0]) for text in texts}


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_no_module_gives_one_name_to_two_values():
    # A rename once did: names next to both heads then weighed 1.25 in place of 0.5.
    twice = []
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        body = ast.parse(path.read_text("utf-8")).body
        targets = [one.target for one in body if isinstance(one, ast.AnnAssign)]
        targets += [each for one in body if isinstance(one, ast.Assign) for each in one.targets]
        names = [each for target in targets for each in ast.walk(target)]
        stored = [each for each in names if isinstance(getattr(each, "ctx", None), ast.Store)]
        counts = Counter(each.id for each in stored if isinstance(each, ast.Name))
        twice += [f"{path}: {name}" for name, count in counts.items() if count > 1]
    assert twice == []


def imported(folders):
    """Name what the modules of some folders import of others."""
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield node.module


@pytest.mark.parametrize(
    ("folders", "extras"),
    [(BOX, ("embedding", "onnx")), (("analyzer", "tools/cli", "tools/home"), EXTRAS)],
)
def test_what_is_imported_is_asked_for(folders, extras):
    names = {name.partition(".")[0] for name in imported(folders)}
    names -= sys.stdlib_module_names | {"hearthlog"}
    owners = packages_distributions()
    requested = requested_for(*extras)
    assert {
        name for name in names if not requested & set(map(normal, owners.get(name, [])))
    } == set()
