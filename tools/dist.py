"""Builds sdist and wheel, and runs the quick tests of the one against the other: `make dist`.

The wheel is installed with what development needs into a new environment, the sdist unpacked where
no checkout is. Its sources are spoilt, so that no test can import them in place of the wheel.
Arguments that are not known here are pytest's: what to run, in place of all quick tests.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
# A test may still copy them, and change and run the copy.
SPOILT = """
if __file__ == {file!r}:
    raise ImportError("the sources of the sdist were imported, not the wheel")
"""


def run(*command: str | Path, cwd: Path = ROOT) -> None:
    """Run a command without the paths that this process was given; what fails here ends it."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(word) for word in command], cwd=cwd, env=environment, check=True)


def build(folder: Path) -> tuple[Path, Path]:
    """The sdist, and the wheel that is built from it."""
    shutil.rmtree(folder, ignore_errors=True)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    [sdist], [wheel] = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def environment(folder: Path, wheel: Path) -> Path:
    """The Python of a new environment, with the wheel and all that its tests need."""
    run(sys.executable, "-m", "uv", "venv", "--quiet", "--python", sys.executable, folder)
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    into = (sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", python)
    run(*into, f"evofsm[dev] @ {wheel.as_uri()}")
    return python


def main() -> int:
    """Build, install, test; 1 where one of them fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only-build", action="store_true", help="build into dist/, test nothing")
    arguments, of_pytest = parser.parse_known_args()
    sdist, wheel = build(ROOT / "dist")
    if arguments.only_build:
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        python = environment(folder / "venv", wheel)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        tests = folder / sdist.name.removesuffix(".tar.gz")
        face = tests / "src" / "evofsm" / "__init__.py"
        face.write_text(face.read_text("utf-8") + SPOILT.format(file=str(face)), "utf-8")
        where = of_pytest or ["studies", "tests", "README.md", "docs", "--pyargs", "evofsm"]
        try:
            run(python, "-m", "pytest", "-q", "-m", "not slow", "-n", "2", *where, cwd=tests)
        except subprocess.CalledProcessError as failed:
            return failed.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
