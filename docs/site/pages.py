"""What the site is made of: the pages of the repository at their own places, so that their links hold, and a page of
reference for each package, with every public name."""

from __future__ import annotations

import ast
import pathlib
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = pathlib.Path(__file__).resolve().parents[2]

#: Pages and what they link to, and where else than in docs they lie.
KEPT = (
    *("*.md", "docs/*.md", "docs/pictures/*.*", "docs/results/*.json", "benchmarks/*.md"),
    *("examples/*.py", "examples/clusters/*.*", "LICENSE", "NOTICE"),
)


def public_names() -> dict[str, str]:
    """The module of each public name, as `warpcage/__init__.py` lists them, read without importing it."""
    tree = ast.parse((ROOT / "warpcage" / "__init__.py").read_text(encoding="utf-8"))
    (homes,) = (node.value for node in tree.body if isinstance(node, ast.Assign) and _is_named(node, "_HOMES"))
    return {name: module for module, names in ast.literal_eval(homes).items() for name in names}


def _is_named(node: ast.Assign, name: str) -> bool:
    return isinstance(node.targets[0], ast.Name) and node.targets[0].id == name


def reference() -> dict[str, str]:
    """The pages of reference by their paths."""
    pages: dict[str, str] = {}
    for name, module in sorted(public_names().items(), key=lambda each: (each[1].partition(".")[0], each[0].lower())):
        package = module.partition(".")[0]
        pages.setdefault(f"reference/{package}.md", f"# {package}\n")
        pages[f"reference/{package}.md"] += f"\n::: warpcage.{module}.{name}\n"
    return pages


def parts() -> dict[str, list[str]]:
    """The pages of each part of `docs/README.md`, in its order: the first link of each row."""
    pages: dict[str, list[str]] = {}
    for part in (ROOT / "docs" / "README.md").read_text(encoding="utf-8").split("\n## ")[1:]:
        links = re.findall(r"^\| \[\w+\]\((.*?)\)", part, re.MULTILINE)
        paths = ((ROOT / "docs" / link).resolve() for link in links)
        pages[part.partition("\n")[0]] = [path.relative_to(ROOT).as_posix() for path in paths]
    return pages


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The parts of docs, with the reference of all names, in the navigation."""
    notes = [f"benchmarks/{path.name}" for path in sorted((ROOT / "benchmarks").glob("*.md"))]
    groups = parts()
    groups["Reference"] = [*reference(), *groups["Reference"]]
    groups |= {"Notes": notes, "Changelog": ["CHANGELOG.md"]}
    config.nav = [*(config.nav or ()), *({name: pages} for name, pages in groups.items())]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The theme's files, the repository's pages, and the reference."""
    docs = pathlib.Path(config.docs_dir)
    kept = [file for file in files if not pathlib.Path(file.abs_src_path or "").is_relative_to(docs)]
    found = sorted(path for pattern in KEPT for path in ROOT.glob(pattern))
    for path in found:
        name = path.relative_to(ROOT).as_posix()
        kept.append(File.generated(config, name, abs_src_path=str(path)))
    kept += [File.generated(config, name, content=text) for name, text in reference().items()]
    return Files(kept)


def on_page_content(html: str, **_: object) -> str:
    """Docstrings end a line before a block as reStructuredText has it, with two colons; pages with one."""
    return html.replace("::</p>", ":</p>")
