"""Machine code of every kernel for one architecture, made without a GPU: its hash, registers, stack and size.

    python benchmarks/machine_code.py --out now.json
    python benchmarks/machine_code.py --tree ../older --out before.json
    python benchmarks/machine_code.py --compare before.json now.json

A change of text or of files alone leaves all code equal. A kernel of the first list counts as equal where its code
occurs in the second one, under any name; the others are shown beside the kernel of the same name, if there is one. The
exit status of a comparison is 1 where code is not equal.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import importlib
import json
import os
import pathlib
import struct
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

#: Ends of the names under which Warp compiles a kernel, and what is known of each.
SUFFIX = "_cuda_kernel_forward"
FIGURES = ("registers", "stack", "bytes")

#: Tags of the section ".nv.info" of a cubin: registers, and two that hold the stack of a function.
REGISTERS, STACK = 0x2F, (0x11, 0x12)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", default=str(pathlib.Path(__file__).resolve().parents[1]), help="the checkout")
    parser.add_argument("--arch", type=int, default=90)
    parser.add_argument("--only", nargs="*", default=(), help="kernel files whose names contain one of these strings")
    parser.add_argument("--out", help="JSON file")
    parser.add_argument("--compare", nargs=2, metavar=("BEFORE", "NOW"), help="two such files")
    args = parser.parse_args()
    if args.compare:
        return compare(*(json.loads(pathlib.Path(path).read_text())["kernels"] for path in args.compare))
    sys.path.insert(0, os.path.abspath(args.tree))
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["WARP_CACHE_PATH"] = temporary
        kernels = kernel_codes(args.arch, args.only, temporary)
    if args.out:
        text = json.dumps({"arch": args.arch, "kernels": kernels}, indent=1)
        pathlib.Path(args.out).write_text(text + "\n", encoding="utf-8")
    return 0


def kernel_codes(arch: int, only: Sequence[str], folder: str) -> dict[str, dict]:
    """Facts of the code of each kernel by its name."""
    import warp as wp

    import warpcage.kernels

    print(f"kernels of {os.path.realpath(warpcage.kernels.__path__[0])}", flush=True)
    found = {}
    for module in kernel_modules(only):
        begin, place = time.perf_counter(), os.path.join(folder, module.name)
        wp.compile_aot_module(module, arch=arch, module_dir=place, use_ptx=False)
        (cubin,) = pathlib.Path(place).glob("*.cubin")
        label = module.name.removeprefix("warpcage.kernels.")
        for name, facts in section_facts(cubin.read_bytes()).items():
            keys = [key for key in module.kernels if name.startswith(key) and name.endswith(SUFFIX)]
            key = max(keys, key=len, default=name)
            found[f"{label}:{key}"] = facts
            figures = "  ".join(f"{facts[figure]:6} {figure}" for figure in FIGURES)
            print(f"{facts['hash']}  {figures}  {label}:{key}  ({time.perf_counter() - begin:.1f} s)", flush=True)
    return found


def kernel_modules(only: Sequence[str] = ()) -> list:
    """The Warp modules of all kernel files, and of their variants, that define kernels."""
    import warp as wp

    from warpcage.core import kernel_names

    modules = {}
    for name in kernel_names():
        if only and not any(word in name for word in only):
            continue
        file = importlib.import_module(f"warpcage.kernels.{name.replace('/', '.')}")
        made = [kernel.module for kernel in file.variants()] if hasattr(file, "variants") else []
        for module in [wp.get_module(file.__name__), *made]:
            if module.kernels:
                modules[module.name] = module
    return list(modules.values())


def section_facts(cubin: bytes) -> dict[str, dict]:
    """Facts of each function of a cubin, an ELF file, by the name of its section of code."""
    (table,) = struct.unpack_from("<Q", cubin, 40)
    count, names_at = struct.unpack_from("<HH", cubin, 60)
    sections = [struct.unpack_from("<IIQQQQIIQQ", cubin, table + 64 * n) for n in range(count)]

    def text(table: tuple, offset: int) -> str:
        begin = table[4] + offset
        return cubin[begin : cubin.index(b"\0", begin)].decode()

    named = [(text(sections[names_at], section[0]), section) for section in sections]
    found = {}
    for name, section in named:
        if name.startswith(".text."):
            code = cubin[section[4] : section[4] + section[5]]
            facts = {"hash": hashlib.sha256(code).hexdigest()[:16], "registers": 0, "stack": 0, "bytes": len(code)}
            found[name.removeprefix(".text.")] = facts
    symbols = dict(named)[".symtab"]
    for name, section in named:
        if name == ".nv.info":
            for tag, symbol, value in info_pairs(cubin[section[4] : section[4] + section[5]]):
                (offset,) = struct.unpack_from("<I", cubin, symbols[4] + 24 * symbol)
                facts = found.get(text(sections[symbols[6]], offset))
                if facts is not None and tag in (REGISTERS, *STACK):
                    facts["registers" if tag == REGISTERS else "stack"] = value
    return found


def info_pairs(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(tag, symbol, value) of each entry of ".nv.info" that holds two numbers."""
    place = 0
    while place < len(data):
        form, tag, size = struct.unpack_from("<BBH", data, place)
        place += 4
        if form == 4:  # else the value stands in place of the size
            if size == 8:
                yield tag, *struct.unpack_from("<II", data, place)
            place += size


def compare(before: dict[str, dict], now: dict[str, dict]) -> int:
    """Print which code of one list is not in the other, by name."""
    left = collections.Counter(facts["hash"] for facts in now.values())
    changed = []
    for name, facts in before.items():
        if left[facts["hash"]] > 0:
            left[facts["hash"]] -= 1
        else:
            changed.append(name)
    added = []
    for name, facts in now.items():
        if left[facts["hash"]] > 0:
            left[facts["hash"]] -= 1
            added.append(name)
    print(f"{len(before) - len(changed)} of {len(before)} kernels have equal code; {len(now)} kernels now")
    for name in changed:
        print(
            f"  not equal: {name}  {figures(before[name])}  ->  {figures(now[name]) if name in now else 'no such name'}"
        )
    for name in added:
        if name not in changed:
            print(f"  new code:  {name}  {figures(now[name])}")
    return 1 if changed or added else 0


def figures(facts: dict) -> str:
    return ", ".join(f"{facts[figure]} {figure}" for figure in FIGURES)


if __name__ == "__main__":
    sys.exit(main())
