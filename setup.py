"""Compile the core while this is being installed; everything else stands in pyproject.toml.

Where there is no C compiler, or no headers of Python, the core is installed as the plain Python that it is:
slower, and the same in everything else (see `companion.compiled`).
"""

import os
import sys
from pathlib import Path

from setuptools import Extension, setup

sys.path.insert(0, str(Path(__file__).parent))  # an isolated build looks for packages elsewhere

from companion.compiled import PACKAGE, source

BUILD = Path("build", "compiled")
BUILDS = frozenset({"bdist_wheel", "build_ext", "editable_wheel"})


def packages() -> None:
    """What the compiled modules go into; pyproject.toml names the place."""
    for module in source.MODULES:
        folder = BUILD.joinpath("package", PACKAGE, *module.split(".")[:-1])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "__init__.py").touch()
    (BUILD / "package" / PACKAGE / "__init__.py").touch()


def extensions() -> list[Extension]:
    """The rewritten core as C."""
    from mypyc.build import mypycify

    files = source.write(BUILD / "source")
    os.environ["MYPYPATH"] = os.pathsep.join((str(BUILD / "source"), "."))
    options = [
        "--config-file=",
        "--explicit-package-bases",
        "--ignore-missing-imports",
        f"--cache-dir={BUILD / 'mypy'}",
    ]
    made = mypycify(
        [*options, *map(str, files)],
        group_name=f"{PACKAGE}.core",
        target_dir=str(BUILD / "c"),
        opt_level="1",  # more takes twice as long, and flies no faster
        debug_level="0",
    )
    for extension in made:
        extension.optional = True  # a build without a compiler goes on
        # Bit for bit the same as Python: no multiplication and addition in one, as ARM's compilers like it.
        extension.extra_compile_args.append("-ffp-contract=off")
        # Calls without stubs between: a loop that has slept runs on cold caches, where every line counts.
        extension.extra_compile_args += ["-fno-plt", "-fvisibility=hidden"]
    return made


packages()
setup(ext_modules=extensions() if BUILDS & set(sys.argv) else [])
