import pathlib
import re

from setuptools import find_packages, setup

# the one version number, read as text: importing the package would need its dependencies
VERSION = re.search(r'^__version__ = "(.+)"$', pathlib.Path("warpcage/__init__.py").read_text("utf-8"), re.MULTILINE)[1]

EDIT = [
    "aiohttp>=3.10",  # the server of the page and its WebSockets
    "simplejpeg>=1.7",  # pictures to the page: libjpeg-turbo without the lock of the interpreter
    "platformdirs>=4.0",  # where the demo is kept
]

EXR = ["OpenEXR>=3.3"]  # pictures of light, opacity and depth: from 3.3 on it takes NumPy arrays

HEIF = ["pillow-heif>=1.0"]  # pictures of phones in HEIC

CAPTURE = [
    "pycolmap>=4.2",  # cameras of pictures; from 4.2 on its work can be cancelled
    "av>=14.2",  # from there on frames say how a phone was held
]

USD = ["usd-core>=24.11"]  # stages of USD: from there on it takes arrays of NumPy 2

TEXTURE = [
    "xatlas>=0.0.9",  # unwraps surfaces
    "fast-simplification>=0.1.9",  # makes them light; from there on with NumPy 2
]
COMPLETION = ["argcomplete>=3.1"]  # words of commands in the shell, after Tab

TORCH = ["torch>=2.10"]  # warpcage.torch; its functions inside torch.compile need 2.14

JAX = ["jax>=0.10"]  # warpcage.jax: Warp calls Python from it

CLUSTER = ["ray>=2.40"]  # clusters of `warpcage run`: the core alone, without ray[default]

#: What the programs of warpcage.studio want beside the library: the editor, captures, completion. Clusters stay apart.
STUDIO = [*EDIT, *CAPTURE, *COMPLETION]

DOCS = [
    "mkdocs>=1.6",  # from there on pages are generated in memory
    "mkdocs-material>=9.5",
    "mkdocstrings[python]>=0.26",
]

TEST = [
    *EDIT,
    *EXR,
    *DOCS,
    *HEIF,
    # there are wheels for these; elsewhere tests of USD and textures are skipped
    *(
        f"{need}; sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.14'"
        for need in (*USD, *TEXTURE)
    ),
    *COMPLETION,
    # several workers and clusters; without it those tests are skipped
    "ray>=2.40; sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.14'",
    "selenium>=4.20",  # drives a browser through the editor; those tests are skipped without Chromium
    "pytest>=8.0",
    "webdataset>=1.0",  # reads the shards that records are packed into
    "openjd-cli>=0.7",  # runs the template of render farms; without it that test is skipped
    "pytest-xdist>=3.6",  # over all cores
    "filelock>=3.12",  # what several of its workers need is made by one
    "hypothesis>=6.100",
    "scipy>=1.11",
    "setuptools>=70.1",  # builds the wheel that tests/test_install.py looks into
    # cameras are found by the one, and compared with those of both; without them those tests are skipped
    "opencv-python-headless>=4.10",
    "pycolmap>=4.2; sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.15'",
]

DEV = [
    *TEST,
    "ruff>=0.9",
    "codespell>=2.3",
    "import-linter>=2.6",
    "pyright[nodejs]>=1.1.380",
    "mypy>=1.11",
    "clang-format>=22",
    "pre-commit>=3.7",
    "build>=1.0",
    "matplotlib>=3.8",  # figures of benchmarks
    "uv>=0.5",  # installs the lowest versions, for .ci/clean
]

#: Folders beside the package that are installed as parts of it; in a checkout there are links to them.
LINKED = {"warpcage.kernels": "kernels", "warpcage.examples": "examples"}

setup(
    name="warpcage",
    version=VERSION,
    description="Cage-based deformation of radiance fields: GPU kernels on NVIDIA Warp",
    long_description=open("README.md", encoding="utf-8").read(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    license_files=["LICENSE", "NOTICE"],
    python_requires=">=3.10",
    packages=[
        *find_packages(include=["warpcage", "warpcage.*"], exclude=[f"{name}*" for name in LINKED]),
        "warpcage.kernels",
        *(f"warpcage.kernels.{room}" for room in find_packages("kernels")),
        "warpcage.examples",
    ],
    package_dir={"warpcage": "warpcage", **LINKED},
    package_data={
        "warpcage": ["py.typed", "__init__.pyi"],
        "warpcage.studio.editor": ["page/*", "page/*/*"],
        "warpcage.examples": ["clusters/*"],
        "warpcage.kernels": ["README.md"],
        **{f"warpcage.kernels.{room}": ["*.h", "cpp/*.h", "README.md"] for room in find_packages("kernels")},
    },
    install_requires=[
        "warp-lang>=1.19",
        "numpy>=1.26",
        "trimesh>=4.4",
        "pymeshlab>=2023.12",
        "imageio>=2.36.1",  # from there on MP4 takes rates that are not whole numbers
        "av>=12.0",  # imageio's pyav plugin: MP4 without an ffmpeg executable
        "scikit-image>=0.22",
        "scipy>=1.11",
        "tqdm>=4.66",
        "pillow>=11.3",  # pictures, from there on AVIF, and the WebP in files of splats
        "packaging>=22.0",  # compares versions for `warpcage doctor`
        'zstandard>=0.23; python_version < "3.14"',  # .spz of version 4; from 3.14 on Python has it
    ],
    extras_require={
        "studio": STUDIO,
        "edit": EDIT,
        "exr": EXR,
        "heif": HEIF,
        "usd": USD,
        "texture": TEXTURE,
        "capture": CAPTURE,
        "cluster": CLUSTER,
        "torch": TORCH,
        "jax": JAX,
        "completion": COMPLETION,
        "docs": DOCS,
        "test": TEST,
        "dev": DEV,
    },
    entry_points={"console_scripts": ["warpcage=warpcage.studio.cli:main"]},
    classifiers=[
        "Programming Language :: Python :: 3",
        "Environment :: GPU :: NVIDIA CUDA",
        "Topic :: Scientific/Engineering",
        "Topic :: Multimedia :: Graphics :: 3D Rendering",
    ],
)
