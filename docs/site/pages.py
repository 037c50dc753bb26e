"""What the site is made of: the pages of the repository at their own places, so that their links hold, and a page of
reference for each room, with every public name."""

from __future__ import annotations

import ast
import pathlib

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
        room = module.partition(".")[0]
        pages.setdefault(f"reference/{room}.md", f"# {room}\n")
        pages[f"reference/{room}.md"] += f"\n::: warpcage.{module}.{name}\n"
    return pages


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Reference, results and changelog in the navigation."""
    there = {path for group in config.nav or () for pages in group.values() for path in pages}
    results = [f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))]
    notes = [f"benchmarks/{path.name}" for path in sorted((ROOT / "benchmarks").glob("*.md"))]
    config.nav = [
        *(config.nav or ()),
        {"Reference": list(reference())},
        {"Results": [path for path in (*results, *notes) if path not in there]},
        {"Changelog": ["CHANGELOG.md"]},
    ]
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
