"""C++ of kernels that stands in files beside them."""

from pathlib import Path


def native_source(file: str, name: str) -> str:
    """The text of a C++ file beside a Python file, with the files that it includes in their places."""
    path = Path(file).parent / name
    text = ""
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        text += native_source(str(path), line.split('"')[1]) if line.startswith("#include ") else line
    return text
