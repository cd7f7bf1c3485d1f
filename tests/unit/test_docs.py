# SPDX-License-Identifier: GPL-3.0-or-later
"""The documentation against the tree: links and anchors resolve; commands, flags and files that it names exist."""

import argparse
import importlib.util
import re
import subprocess
from pathlib import Path

import physgen
import pytest
from physgen.batch.cli import build_parser

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / f"{n}.md" for n in ("README", "CONTRIBUTING", "SECURITY", "CHANGELOG")),
]
OTHERS = {
    "--background",
    "--python",
    "--python-expr",
    "--factory-startup",
    "--profile",
    "--addons",
    "--help",
    "--no-deps",
    "--import-mode",
    "--find-links",
    "--no-index",
    "--strict",
    "--data",
    "--gres",
    "--nthreads",
    "--qos",
    "--tls-ca-file",
}
"""Flags of Blender, pip and other programs that the pages name."""


def prose(page):
    """The page without its fenced code."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def slug(heading):
    """Anchor of a heading, as MkDocs and GitHub make it of plain text."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "")
    return re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())


def anchors(page):
    return {slug(line.lstrip("#")) for line in prose(page).splitlines() if re.match(r"#{1,6} ", line)}


def commands():
    """Each verb of ``physgen`` with its flags; nested verbs as "verb sub"."""
    found = {}

    def collect(parser, name):
        flags = {text for action in parser._actions for text in action.option_strings}
        found[name] = flags
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for verb, sub in action.choices.items():
                    collect(sub, f"{name} {verb}".strip())

    collect(build_parser(), "")
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_and_anchors_resolve(page):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = page.parent / name if name else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_no_heading_comes_twice(page):
    headings = [slug(line.lstrip("#")) for line in prose(page).splitlines() if re.match(r"#{1,3} ", line)]
    if page.name != "CHANGELOG.md":
        assert len(set(headings)) == len(headings), sorted(h for h in headings if headings.count(h) > 1)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_verbs_and_their_flags_exist(page):
    known = commands()
    verbs = {name.split()[0] for name in known if name}
    wrong = []
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    pieces = [
        line for block in re.findall(r"^```\w*\n(.*?)^```$", text, flags=re.M | re.S) for line in block.splitlines()
    ]
    pieces += [code.replace("\n", " ") for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose(page))]
    for piece in pieces:
        # A command at the beginning of the line, or after a path to it; prose and comments behind it do not count.
        match = re.match(r"\s*(?:\$ )?(?:\S*/)?physgen ([a-z][a-z-]*)\b(.*)", piece.split("  #")[0])
        if not match:
            continue
        verb, rest = match.groups()
        if verb not in verbs:
            wrong.append(piece)
            continue
        flags = set().union(*(flags for name, flags in known.items() if name.split()[:1] == [verb]))
        wrong += [f"{verb} {flag}" for flag in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", rest) if flag not in flags]
    assert not wrong


def source_flags():
    """All flags that a program of the tree defines."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py", "*.sh"], cwd=ROOT, capture_output=True, text=True
    ).stdout.split()
    files = [ROOT / name for name in listed] or [*ROOT.glob("[a-z]*/**/*.py")]
    text = "\n".join(
        path.read_text(encoding="utf-8") for path in files if path.is_file() and path.name != Path(__file__).name
    )
    return set(re.findall(r"""["'](--[a-z][a-z0-9-]*)["']""", text))


def test_flags_in_prose_exist():
    known = source_flags() | OTHERS | set().union(*commands().values())
    wrong = {}
    for page in PAGES:
        for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose(page)):
            for flag in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", code):
                if flag not in known and not flag.endswith("-"):
                    wrong.setdefault(page.name, set()).add(flag)
    assert not wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_files_of_the_tree_exist(page):
    missing = []
    for name in re.findall(
        r"`((?:sim|physgen_addon|batch|presets|setup|tests|benchmarks|examples|docs)/[\w./*-]+)", prose(page)
    ):
        name = name.rstrip("./").replace("NAME", "*")
        if not any(ROOT.glob(name)) and not any(ROOT.glob(f"{name}.*")):
            missing.append(name)
    assert not missing


@pytest.mark.parametrize(
    "package",
    [p.parent for p in sorted(ROOT.glob("[a-z]*/**/__init__.py")) if re.search(r"^\w+\.py  ", p.read_text(), re.M)],
    ids=lambda p: p.relative_to(ROOT).as_posix(),
)
def test_a_package_that_lists_its_files_lists_each_and_no_other(package):
    listed = re.findall(r"\b\w+\.py\b", (package / "__init__.py").read_text().split('"""')[1])
    assert set(listed) == {path.name for path in package.glob("[!_]*.py")}


def test_messages_name_pages_that_exist():
    """Docstrings, messages and comments of the tree name ``docs/…md`` and anchors that are there."""
    wrong = []
    for folder in ("sim", "physgen_addon", "batch", "benchmarks", "setup", "examples", "presets"):
        for path in (ROOT / folder).rglob("*.*"):
            if path.suffix not in (".py", ".toml", ".js", ".sh"):
                continue
            for name, anchor in re.findall(r"docs/([\w-]+\.md)(?:#([\w-]+))?", path.read_text(encoding="utf-8")):
                page = ROOT / "docs" / name
                if not page.is_file() or (anchor and anchor not in anchors(page)):
                    wrong.append(f"{path.relative_to(ROOT)}: {name}")
    assert not wrong


def test_every_page_is_in_the_site():
    listed = re.findall(
        r"^\s+- (?:[^:\n]+: )?([\w-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), flags=re.M
    )
    assert sorted(listed) == sorted(p.name for p in (ROOT / "docs").glob("*.md"))


def test_every_source_names_a_licence_whose_text_is_there():
    texts = {path.stem for path in (ROOT / "LICENSES").glob("*.txt")}
    without = []
    for folder in ("sim", "physgen_addon", "batch", "presets", "setup", "tests", "benchmarks", "examples"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".sh", ".js") and "__pycache__" not in path.parts:
                start = path.read_text(encoding="utf-8")[:400]
                found = re.search(r"SPDX-License-Identifier: (\S+)", start)
                if not found or found[1] not in texts:
                    without.append(str(path.relative_to(ROOT)))
    assert not without


def test_the_api_reference_has_every_public_name():
    spec = importlib.util.spec_from_file_location("api_reference", ROOT / "setup" / "api_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.reference()
    for name in getattr(physgen, "__all__", ()):
        assert f"physgen.{name}`" in text
    assert "doctest" not in text and ">>>" not in text
