"""The rules of the house about what is written: docstrings, names, messages, imports, help, tables of docs.

Each function marked `rule` gives what is wrong, a line each; `test_house_style.py` runs them all. Files are read and
parsed once for all rules.
"""

import ast
import builtins
import collections
import dataclasses
import functools
import importlib
import inspect
import json
import pathlib
import re
import sys
import textwrap
import warnings

import golden_names
from messages import MESSAGES

import warpcage
from warpcage import errors
from warpcage.core import COORDINATES
from warpcage.package import MOVED, NEEDED

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGE, KERNELS, TESTS, DOCS = ROOT / "warpcage", ROOT / "kernels", ROOT / "tests", ROOT / "docs"

RULES = {}


def rule(function):
    RULES[function.__name__] = function
    return function


@functools.cache
def text(path):
    return path.read_text(encoding="utf-8")


@functools.cache
def parsed(path):
    return ast.parse(text(path))


@functools.cache
def python_files(*folders):
    """The files of some folders, without those that links lead to."""
    links = {PACKAGE / "kernels", PACKAGE / "examples"}
    found = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    return [path for path in found if links.isdisjoint(path.parents)]


def name_of(path):
    return path.relative_to(ROOT).as_posix()


@functools.cache
def nodes(path):
    """All nodes of a file of the package or the kernels, which several rules look through."""
    return list(ast.walk(parsed(path)))


# -- docstrings

SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Example|Note|Limitations|References):\s*$")
ENTRY = re.compile(r"^    (\*{0,2}\w+): \S")


def sections(docstring):
    """The lines below each heading of a docstring, by heading; what comes before the first is under ""."""
    found, heading = {"": []}, ""
    for line in inspect.cleandoc(docstring or "").splitlines():
        match = SECTION.match(line)
        if match:
            heading = match[1]
            assert heading not in found, f"two sections {heading}"
            found[heading] = []
        else:
            found[heading].append(line)
    return found


def entries(lines):
    """The names that a section describes, each on a line of its own."""
    return [match[1].lstrip("*") for match in map(ENTRY.match, lines) if match]


def docstring_complaints(item):
    """What is wrong with the docstring and the annotations of a public name."""
    docstring = inspect.getdoc(item) if not inspect.isclass(item) else item.__doc__
    if not docstring:
        return ["it has no docstring"]
    summary = inspect.cleandoc(docstring).splitlines()[0]
    found = [] if summary.endswith((".", ":")) else [f"its summary {summary!r} is not one line that ends"]
    if isinstance(item, property):
        return found + ([] if "return" in item.fget.__annotations__ else ["its value is not annotated"])

    if inspect.isclass(item) and issubclass(item, Exception):  # made of a message alone
        return found
    function, bound = golden_names.callable_of(item)
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())[1 if bound else 0 :]
    parts = sections(docstring)
    described = entries(parts.get("Args", ()))
    if dataclasses.is_dataclass(item):  # whose fields are attributes too
        described += entries(parts.get("Attributes", ()))
    names = [parameter.name for parameter in parameters]
    found += [f"{name} is not described" for name in names if name not in described]
    takes_more = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    found += [f"{name} is described, but no parameter" for name in described if name not in names and not takes_more]
    found += [f"{each.name} is not annotated" for each in parameters if each.annotation is each.empty]
    if inspect.isclass(item):
        return found
    if signature.return_annotation is inspect.Signature.empty:
        found.append("what it returns is not annotated")
    elif parameters and signature.return_annotation not in (None, "None") and not {"Returns", "Yields"} & set(parts):
        found.append("what it returns is not described")  # without parameters the summary says it, as for properties
    return found


@rule
def every_parameter_is_described_and_annotated():
    methods = property | classmethod | staticmethod
    for name, item in golden_names.public_objects():
        if "." not in name or inspect.isfunction(item) or isinstance(item, methods):
            yield from (f"{name}: {complaint}" for complaint in docstring_complaints(item))


MAX_LINES = 2

#: Public functions of warpcage.torch and warpcage.jax that the package itself has as methods.
PASSING = ("render", "to_canonical")

#: Functions that docs offer, which are not at the top of the package.
OFFERED = ("frame_gradient", "deform_points_vjp", "coordinates_vjp")
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def documented_nodes(node, owners=(), owner=None):
    """(name with its owners, class, node) of all that may have a docstring."""
    if isinstance(node, Documented):
        owners = owners if isinstance(node, ast.Module) else (*owners, node.name)
        yield ".".join(owners), owner, node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            within = node if isinstance(node, ast.ClassDef) else None
            yield from documented_nodes(child, owners, within)


def public_classes(trees):
    """Names of the public classes and of all of the package's own classes that they are made from."""
    bases = collections.defaultdict(set)
    for tree in trees:
        for _, _, node in documented_nodes(tree):
            if isinstance(node, ast.ClassDef):
                bases[node.name] |= {base.id for base in node.bases if isinstance(base, ast.Name)}
    found, new = set(), set(warpcage.__all__)
    while new:
        found |= new
        new = {base for name in new for base in bases[name]} - found
    return found


@rule
def internal_docstrings_have_one_sentence(trees=None):
    """On two lines at most: reasons are comments at their lines."""
    trees = trees or {name_of(path): parsed(path) for path in python_files(PACKAGE, KERNELS)}
    public = public_classes(trees.values())
    for path, tree in trees.items():
        for name, owner, node in documented_nodes(tree):
            if ast.get_docstring(node, clean=False) is None:
                continue
            member = owner is not None and owner.name in public and not node.name.startswith("_")
            own = not isinstance(node, ast.Module) and node.name in warpcage.__all__
            own = own or (name in PASSING and path.startswith(("warpcage/torch/", "warpcage/jax/")))
            own = own or name in OFFERED
            lines = node.body[0].end_lineno - node.body[0].lineno + 1
            if lines > MAX_LINES and not (member or own) and not (path == "warpcage/__init__.py" and not name):
                yield f"{path}: {name}"


@rule
def constants_have_one_value(trees=None):
    """A second assignment would change what kernels above it read, which look constants up when they are compiled."""
    trees = trees or {name_of(path): parsed(path) for path in python_files(PACKAGE, KERNELS)}
    for path, tree in trees.items():
        named = [node.targets if isinstance(node, ast.Assign) else [node.target] for node in tree.body
                 if isinstance(node, ast.Assign | ast.AnnAssign)]  # fmt: skip
        names = [each.id for targets in named for each in targets if isinstance(each, ast.Name) and each.id.isupper()]
        yield from (f"{path}: {name}" for name in sorted({name for name in names if names.count(name) > 1}))


@rule
def kernels_have_no_lists_of_needs():
    """The imports of a file say what it needs."""
    for path in python_files(KERNELS):
        for _, _, node in documented_nodes(parsed(path)):
            if "Needs:" in (ast.get_docstring(node) or ""):
                yield name_of(path)


# -- messages

SENTENCE = 40  # letters of a pattern, from which on it belongs in the table
TABLE = TESTS / "support" / "messages.py"


def strings(node):
    """All texts of the source below a node but docstrings, an f-string without its values."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.JoinedStr):
        return ["".join(each for part in node.values if isinstance(part, ast.Constant) for each in strings(part))]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return []
    return [each for child in ast.iter_child_nodes(node) for each in strings(child)]


def names_in(node):
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} - {"MESSAGES"}


def patterns(file):
    """All that `match` may be in a file: where it is not written there, any text of its test or of a table that the
    test names."""
    tables = {
        name: each.value for each in file.body if isinstance(each, ast.Assign) for name in names_in(each.targets[0])
    }
    for test in file.body:
        matches = [each for each in ast.walk(test) if isinstance(each, ast.keyword) and each.arg == "match"]
        places = [*matches]
        if any(names_in(each) for each in matches):
            places += [test, *(tables[name] for name in names_in(test) & tables.keys())]
        yield from (pattern for place in places for pattern in strings(place))


@rule
def sentences_of_messages_stand_in_the_table_alone():
    for path in python_files(TESTS):
        if path != TABLE and "match=" in text(path):
            yield from (f"{name_of(path)}: {each}" for each in patterns(parsed(path)) if len(each) >= SENTENCE)


@rule
def the_table_of_messages_is_in_order_and_used():
    (table,) = (node.value for node in parsed(TABLE).body if isinstance(node, ast.Assign))
    keys = [ast.literal_eval(key) for key in table.keys]
    if keys != sorted(set(keys)) or len(set(MESSAGES.values())) != len(keys):
        yield "it is not in order, or holds something twice"
    used = re.compile(r"\bMESSAGES\[\"([\w.]+)\"\]")
    asked = {key for path in python_files(TESTS) if path != TABLE for key in used.findall(text(path))}
    yield from (f"{key} is in the table or used, and not both" for key in asked ^ set(keys))
    yield from (f"{key} is not PACKAGE.NAME, or no pattern" for key in keys if not re.fullmatch(r"\w+\.\w+", key))
    for pattern in MESSAGES.values():
        re.compile(pattern)


# -- names and imports

#: The paths that users copy from examples and docs: these do not move. A capital begins a class; others are functions.
FIXED = """
cage.pose_file: gltf_poses; cage.snap: snap_to_gaps; cage.walls: cut_faces; core.devices: launch resolve_device;
core.files: atomic_path; core: device_turn; core.names: meant; core.threads: cpu_threads limit_threads;
select.planes: Plane find_planes; fitting.evaluation: evaluate mean_psnr; mesh: MeshFormat write_shown_mesh;
demo.brick_scene: write_brick_scene; demo.bricks: brick_model; demo.cage_scenes: CAGE_SCENES scene_field;
demo.raycast: render_mesh_views; demo.viewpoints: reference_cameras spread_eyes; scene: SceneFormat View
held_out make_scene; splats: SplatContents SplatFormat; studio.cli: main; studio.editor.demo: demo_files;
studio.jobs.items: EvaluateItem FitItem FrameItem Item; studio.jobs.job_file: JobFile write_jobs; studio.jobs.run:
run_jobs; studio.jobs.sweeps: GivenSource RandomSource write_sweep; studio.jobs.webdataset: read_shard shard_path;
studio.films.motion: pose_weights; studio.films.video: write_film write_gif write_video; studio.jobs.worker: Worker;
view.camera: Camera framing_orbit; view.exr: write_exr; view.frame_parts: mask_picture rgba_picture;
view.overlay: draw_cage; view.pictures: color_disparity contact_sheet disparity_range read_image to_uint8 write_png
"""
FIXED = {
    f"warpcage.{module}": names.split()
    for module, _, names in (each.strip().partition(": ") for each in " ".join(FIXED.split()).split(";"))
}


def kind_of(item):
    return "class" if inspect.isclass(item) else "function" if callable(item) else type(item).__name__


@rule
def paths_that_users_know_stay():
    """A name that is public too is one object, wherever it is taken from."""
    for module, names in FIXED.items():
        for name in names:
            item = getattr(importlib.import_module(module), name, None)
            meant = "dict" if name.isupper() else "class" if name[0].isupper() else "function"
            if kind_of(item) != meant or (name in warpcage.__all__ and item is not getattr(warpcage, name)):
                yield f"{module}.{name}"
    for name in ("warpcage.__main__", "warpcage.cli.__main__"):  # the program starts by both names
        if importlib.util.find_spec(name) is None:
            yield name


@rule
def paths_that_moved_are_found_with_a_warning():
    """A module is the same one by its old name, and so are those in it."""
    for old, new in MOVED.items():
        for module in [new, *(each for each in FIXED if each.startswith(f"{new}."))]:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                sys.modules.pop(old + module[len(new) :], None)
                found = importlib.import_module(old + module[len(new) :])
            warned = any(f"is {module} now" in str(each.message) for each in said)
            if found is not importlib.import_module(module) or not warned:
                yield old


def copied_texts():
    """(where, text) of all that users copy: examples, and the Python of README and docs."""
    for path in sorted((ROOT / "examples").rglob("*")):
        if path.suffix in (".py", ".sh", ".sbatch", ".yaml", ".yml", ".md"):
            yield name_of(path), text(path)
    for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]:
        for number, block in enumerate(re.findall(r"```python\n(.*?)```", text(page), re.DOTALL), 1):
            yield f"{name_of(page)}, block {number}", textwrap.dedent(block)


def imports(text):
    """(module, names) of the lines that import of warpcage; names are empty for `import MODULE`."""
    found = []
    for match in re.finditer(r"^[ \t>.]*from (warpcage[\w.]*) import (\([^)]*\)|[^\n#;]*)", text, re.MULTILINE):
        names = [name.split(" as ")[0].strip() for name in match[2].strip("() \n").split(",")]
        found.append((match[1], [name for name in names if name]))
    found += [(name, []) for name in re.findall(r"^[ \t>.]*import (warpcage[\w.]*)", text, re.MULTILINE)]
    return found


def attributes(text):
    """What is taken of `warpcage` by dots: "Cage", "studio.films.video.write_film"."""
    try:
        tree = ast.parse(text)
    except SyntaxError:  # a part of a program, or none
        return set(re.findall(r"\bwarpcage\.([A-Za-z_]\w*)\(", text))
    chains = set()
    for node in ast.walk(tree):
        names = []
        while isinstance(node, ast.Attribute):
            names.append(node.attr)
            node = node.value
        if names and isinstance(node, ast.Name) and node.id == "warpcage":
            chains.add(names[-1])
    return chains


@rule
def imports_of_examples_and_pages_work_and_are_in_the_list():
    """So that a path that a new example names is one that stays."""
    deep = 0
    for where, copied in copied_texts():
        for module, names in imports(copied):
            found = importlib.import_module(module)
            for name in names:
                deep += module != "warpcage"
                if not hasattr(found, name):
                    importlib.import_module(f"{module}.{name}")
                if module != "warpcage" and name not in FIXED.get(module, ()):
                    yield f"{where}: {module}.{name} is not in the list of paths that stay"
        yield from (f"{where}: {name}" for name in attributes(copied) if not hasattr(warpcage, name))
    if deep <= 20:
        yield "no imports of examples are found"


@rule
def the_stub_tells_type_checkers_the_same_names():
    homes, exported = {}, None
    for node in ast.parse(text(PACKAGE / "__init__.pyi")).body:
        if isinstance(node, ast.ImportFrom):
            if node.level != 1 or any(each.name != each.asname for each in node.names):
                yield ast.unparse(node)
            homes |= {each.name: node.module for each in node.names}
        elif isinstance(node, ast.Assign):
            exported = ast.literal_eval(node.value)
    lazy = warpcage._HOMES  # noqa: SLF001  (no public name says where each one comes from)
    if homes != {name: module for module, names in lazy.items() for name in names}:
        yield "names come from other modules"
    if not exported == warpcage.__all__ == sorted(warpcage.__all__, key=lambda name: (name[0].islower(), name)):
        yield "__all__ is another, or not sorted"


@rule
def what_the_package_needs_at_once_is_listed():
    imported = collections.defaultdict(set)
    for path in python_files(PACKAGE, KERNELS):
        for node in parsed(path).body:
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in names:
                imported[name.split(".")[0]].add(path.parent.name)
    # these are loaded once the extra has been looked for, or where a folder is asked for by name
    for name, folders in {"aiohttp": {"editor", "web"}, "torch": {"torch"}, "jax": {"jax"}}.items():
        if imported.pop(name, folders) != folders:
            yield f"{name} is imported elsewhere"
    others = set(imported) - set(sys.stdlib_module_names) - {"warpcage"}
    yield from (f"{name} is imported or needed, and not both" for name in others ^ set(NEEDED))


# -- what version 0.1.0 offered

GOLDEN = json.loads(text(TESTS / "data" / "public_names.json"))
NAMED = ("", "*")  # kinds of parameters that are given by name
HELP = TESTS / "data" / "help"


def refusals(item, was):
    """What a call with all parameters of then, as of then, is refused for; empty where it is taken."""
    function, bound = golden_names.callable_of(item)
    needed = [name for name, kind, *default in was["parameters"] if not default and kind == ""]
    named = [name for name, kind, *_ in was["parameters"] if kind in NAMED and name not in needed]
    first = ["self"] if bound else []
    said = []
    for follow in (True, False):  # what accepts old names may wrap a function that does not
        signature = inspect.signature(function, follow_wrapped=follow)
        try:
            signature.bind(*first, *needed, **dict.fromkeys(named))
            signature.bind(*first, **dict.fromkeys([*needed, *named]))
            signature.bind(*first, *needed)
            return []
        except TypeError as error:
            said.append(str(error))
    return said


def changed_defaults(item, was):
    """Parameters that are still there with another default."""
    function, _ = golden_names.callable_of(item)
    parameters = inspect.signature(function).parameters
    then = {name: default[0] if default else None for name, _, *default in was["parameters"] if name in parameters}
    now = {name: parameters[name].default for name in then}
    texts = {name: None if value is inspect.Parameter.empty else repr(value) for name, value in now.items()}
    return {name: (then[name], texts[name]) for name in then if then[name] != texts[name]}


@rule
def public_names_parameters_and_defaults_stay():
    objects = dict(golden_names.public_objects())
    for name, was in GOLDEN.items():
        owner, _, member = name.partition(".")
        item = getattr(warpcage, owner, None)
        if not member and (name not in warpcage.__all__ or name not in dir(warpcage)):
            yield f"{name} is gone"
        elif member and not (hasattr(item, member) or member in getattr(item, "__dataclass_fields__", {})):
            yield f"{name} is gone"  # a dataclass has members without a default on objects alone
        elif was:
            item = objects.get(name) or getattr(warpcage, name)
            yield from (f"{name}: {complaint}" for complaint in refusals(item, was))
            yield from (f"{name}: default of {changed}" for changed in changed_defaults(item, was).items())
            described = "\n" + (inspect.getdoc(item) or "")
            for each in set(was.get("attributes", ())) - set(golden_names.documented(item)):
                if not hasattr(item, each) and f"\n    {each}: " not in described:
                    yield f"{name}: its attribute {each} is not described"


@rule
def help_is_what_it_was():
    """On every version of Python; and there are no other commands."""
    commands = {path.stem for path in HELP.glob("*.txt")} - {golden_names.PROGRAM}
    yield from (f"{name} is a new command, or gone" for name in commands ^ set(golden_names.commands()))
    for name in sorted([*commands, golden_names.PROGRAM]):
        now = golden_names.help_text("" if name == golden_names.PROGRAM else name)
        if golden_names.plain_help(now) != golden_names.plain_help(text(HELP / f"{name}.txt")):
            yield f"help of {name} is another"


@rule
def the_page_of_commands_is_what_they_say():
    """`python docs/site/commands.py` writes it."""
    spec = importlib.util.spec_from_file_location("commands", DOCS / "site" / "commands.py")
    commands = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(commands)
    for page, path in ((commands.page(), commands.PAGE), (commands.keys_page(), commands.KEYS_PAGE)):
        if page != text(path):
            yield name_of(path)


# -- errors, and kinds of coordinates

#: Exceptions of Python's that are made, by file: what Python itself asks for, what ends a thread, what cannot be, and
#: what a package says that is not whole.
MADE = {
    "package.py": {"AttributeError", "ImportError"},
    "studio/captures/colmap.py": {"InterruptedError"},
    "studio/jobs/films.py": {"InterruptedError"},
    "studio/jobs/manifest.py": {"OSError"},  # for `file_error`
}


@rule
def refusals_are_errors_of_the_package():
    """Each class of them stands in the table of docs."""
    for path in python_files(PACKAGE):
        made = set()
        for node in nodes(path):
            called = node.func if isinstance(node, ast.Call) else node.exc if isinstance(node, ast.Raise) else None
            item = getattr(builtins, called.id, None) if isinstance(called, ast.Name) else None
            if isinstance(item, type) and issubclass(item, Exception):
                made.add(called.id)
        name = path.relative_to(PACKAGE).as_posix()
        if made != MADE.get(name, set()):
            yield f"{name} makes {sorted(made)}"
    page = text(DOCS / "pipelines.md")
    for name, kind in vars(errors).items():
        if isinstance(kind, type) and issubclass(kind, errors.Error) and kind is not errors.Error:
            if f"| `{kind.__name__}` |" not in page:
                yield f"docs/pipelines.md lacks {name}"


def asks_kind(test):
    return isinstance(test, ast.Compare) and any(
        isinstance(each, ast.Constant) and each.value in COORDINATES for each in [test.left, *test.comparators]
    )


@rule
def no_code_asks_for_a_kind_of_coordinates_by_name():
    """What differs between kinds is in their rows (coordinate_kinds.py)."""
    for path in python_files(PACKAGE, KERNELS):
        yield from (f"{name_of(path)}:{node.lineno}" for node in nodes(path) if asks_kind(node))
