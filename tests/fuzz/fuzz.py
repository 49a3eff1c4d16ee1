"""Fuzz the readers of files: `python tests/fuzz/fuzz.py [TARGET ...] --seconds 60`.

A target takes bytes as a file's content. Whatever they are, a reader answers with sound numbers or
with a `ValueError` that names the file; anything else is a finding, and is kept beside the corpus.
Coverage guides the search where atheris is installed (`pip install atheris`); without it, what is
in the corpus is changed at random.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import sys
import tempfile
import time
import warnings
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"
_FILE = Path(tempfile.gettempdir()) / f"evofsm-fuzz-{os.getpid()}"


# -- Targets --------------------------------------------------------------------------------------


def csv(data):
    """A log in CSV: what is read is sound, and the compiled reader agrees with the careful one."""
    from evofsm.io import tables

    as_usual = _outcome(data)
    compiled, tables.parse_plain = tables.parse_plain, lambda *given: None
    try:
        carefully = _outcome(data)
    finally:
        tables.parse_plain = compiled
    if repr(as_usual) != repr(carefully):  # of NaN, too
        raise AssertionError(f"compiled: {as_usual}\ncareful: {carefully}")


def fcd(data):
    """FCD output in XML."""
    _outcome(b"<" + data.removeprefix(b"<"))


def gzipped(data):
    """Whatever it is, packed: the content is cut or changed after that."""
    _outcome(b"\x1f\x8b" + data.removeprefix(b"\x1f\x8b"))


def parquet(data):
    """A log in Parquet."""
    _outcome(b"PAR1" + data.removeprefix(b"PAR1"))


def stored(data):
    """The file of a machine or a model."""
    from evofsm.fsm.machine import EvolvingFSM
    from evofsm.fsm.model import FSMModel

    _FILE.write_bytes(data)
    for kind in (EvolvingFSM, FSMModel):
        try:
            loaded = kind.load(_FILE)
        except ValueError as error:
            _must_name_the_file(error)
            continue
        matrices = loaded.transition_matrices
        if not (abs(matrices.sum(axis=-1) - 1.0) < 1e-6).all():
            raise AssertionError(f"rows of the loaded matrices are no distributions: {matrices}")


def osi(data):
    """A trace of OSI, which is known by its name."""
    _outcome(data, _FILE.with_suffix(".osi"))


TARGETS = {target.__name__: target for target in (csv, fcd, gzipped, parquet, stored, osi)}


def _outcome(data, path=_FILE):
    """The chunks that are read, as bytes, or what was said against them."""
    from evofsm.io.traces import read_traces

    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", ResourceWarning)  # of what an error still holds
            chunks = list(read_traces([str(path)]))
    except ValueError as error:
        _must_name_the_file(error)
        return str(error)
    for chunk in chunks:
        _must_be_sound(chunk)
    return [tuple(getattr(part, "tolist", lambda p=part: p)() for part in c[1:4]) for c in chunks]


def _must_name_the_file(error):
    if str(_FILE) not in str(error):
        raise AssertionError(f"the message does not name the file: {error!r}") from error
    if len(str(error)) > 2000:
        raise AssertionError(f"a message of {len(str(error))} characters")


def _must_be_sound(chunk):
    import numpy as np

    rows = len(chunk.times)
    assert rows > 0
    assert len(chunk.observations) == len(chunk.actions) == rows
    assert np.isfinite(chunk.observations).all()
    assert np.isfinite(chunk.times).all()
    assert not np.isinf(chunk.actions).any()
    assert (np.diff(chunk.starts) > 0).all()
    assert math.isnan(chunk.dt) or chunk.dt > 0.0
    if len(chunk.starts):
        assert 0 <= chunk.starts[0]
        assert chunk.starts[-1] < rows


def seeds(name):
    """The inputs that are kept for a target."""
    return sorted((CORPUS / name).iterdir())


# -- Searching ------------------------------------------------------------------------------------


def guided(name, seconds, found):
    """By coverage, with atheris; it takes the process over and ends it."""
    import atheris

    # Kernels as Python: covered like the rest, and an index beyond an array is an IndexError.
    with atheris.instrument_imports(include=["evofsm.io"]):
        import evofsm.io.traces  # noqa: F401
    options = [f"-max_total_time={seconds}", f"-artifact_prefix={found}/{name}-", "-timeout=20"]
    scratch = tempfile.mkdtemp(prefix="evofsm-fuzz-")
    folders = [scratch, str(CORPUS / name)]  # what is new goes into the first
    options += ["-rss_limit_mb=2048", "-max_len=20000", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], *options, *folders], TARGETS[name])
    atheris.Fuzz()


def at_random(name, seconds, found, seed=0):
    """Changed corpus; answers executions and findings."""
    draw = random.Random(seed)
    known = [path.read_bytes() for path in seeds(name)]
    ends, done, kinds = time.monotonic() + seconds, 0, set()
    while time.monotonic() < ends:
        data = mutated(draw, known)
        try:
            TARGETS[name](data)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            if (kind := _kind_of(error)) not in kinds:
                kinds.add(kind)
                kept = Path(found) / f"{name}-{len(kinds)}"
                kept.write_bytes(data)
                print(f"{kept}: {error!r}"[:500], file=sys.stderr)
        done += 1
    return done, len(kinds)


def _kind_of(error):
    """What tells one finding from another: the error, and the line it comes from."""
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return type(error), place and (place.tb_frame.f_code.co_filename, place.tb_lineno)


def mutated(draw, known):
    """One of the known inputs, changed in a few places; sometimes with a part of another."""
    data = bytearray(draw.choice(known))
    for _ in range(draw.randint(1, 4)):
        at = draw.randint(0, len(data))
        length = draw.choice([0, 1, 1, 2, 8, 40])
        other = draw.choice(known)
        begin = draw.randint(0, len(other))
        put = draw.choice(
            [
                b"",
                bytes(draw.choices(range(256), k=length)),
                draw.choice([b",", b"\n", b'"', b"<", b"nan", b"1e308", b"-0", b"\x00", b"\xff"]),
                bytes(data[at : at + length]) * draw.choice([2, 100]),
                other[begin : begin + draw.choice([4, 40, 400])],
            ]
        )
        data[at : at + length] = put
    return bytes(data)


def main():
    """Fuzz the targets that are named, or all, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", default=list(TARGETS), help=", ".join(TARGETS))
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    parser.add_argument("--found", default=tempfile.gettempdir(), help="folder for findings")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true", help="by coverage, with atheris")
    asked = parser.parse_args()
    Path(asked.found).mkdir(parents=True, exist_ok=True)
    # Compiled code that looks where an array ends, apart from that which does not.
    os.environ["NUMBA_BOUNDSCHECK"] = "1"
    os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / "evofsm-fuzz-kernels")
    total = 0
    for name in asked.targets:
        if name not in TARGETS:
            parser.error(f"there is no target {name!r}, only {', '.join(TARGETS)}")
        if asked.guided:
            if os.fork() == 0:
                os.environ["NUMBA_DISABLE_JIT"] = "1"
                guided(name, asked.seconds, asked.found)
            total += os.wait()[1] != 0
            continue
        done, findings = at_random(name, asked.seconds, asked.found, asked.seed)
        print(f"{name}: {done:,} executions in {asked.seconds} s, {findings} findings")
        total += findings
    for path in (_FILE, _FILE.with_suffix(".osi")):
        path.unlink(missing_ok=True)
    sys.exit(total > 0)


if __name__ == "__main__":
    main()
