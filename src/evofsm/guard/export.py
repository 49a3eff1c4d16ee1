"""A frozen guard in C99: no heap, no recursion, every loop bounded; it decides as it does here.

The C stands beside the Python that it mirrors: ``guard.c`` is the loop, ``learnt/rollout.c`` and
``driving/judge.c`` are judges. What was learnt comes before it, as constants. An FMU is the same C,
compiled where a compiler is, with ``fmi2.c`` around it.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from evofsm import __version__, store
from evofsm.fsm.naming import in_a_line, visible
from evofsm.fsm.rules import reach, weights_of
from evofsm.guard import guard as looping
from evofsm.guard import reviser as revising
from evofsm.guard.actions import Choices, limits, put_into
from evofsm.guard.guard import Guard
from evofsm.guard.learnt import rollout
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.reviser import ActionReviser, Mode

# Rollouts of disturbances lie side by side by so many.
_LANES = 4
# Bytes of the stack, but for what numbers of actions and lanes add; a test holds it to compilers.
_STACK = 2048
# How libraries in an FMU end, by system; and how they are compiled here.
_LIBRARIES = {"darwin": "dylib", "win32": "dll"}
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")


# What no prefix may be: names in the class for C++; in small letters, words of C and C++, headers
# that its file would hide, and what these define.
_TAKEN = """
Action Decision Guard Observation
alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept
const const_cast consteval constexpr constinit continue co_await co_return co_yield decltype default
delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline
int long mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected
public register reinterpret_cast requires restrict return short signed sizeof static static_assert
static_cast struct switch template this thread_local throw true try typedef typeid typename typeof
typeof_unqual union unsigned using virtual void volatile while xor xor_eq assert complex ctype errno
fenv inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic stdbit stdbool
stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
alloca endian features malloc memory pthread sched strings unistd eof file i386 infinity lconv linux
nan null posix std stderr stdin stdout timespec tm unix
"""


class Part(NamedTuple):
    """A judge in C."""

    template: Path
    variables: int  #: that an observation has
    sizes: Mapping[str, int]  #: of its state, for the header
    constants: Mapping[str, Any]  #: numbers and arrays; an empty array is left out
    about: str  #: for people, in the header


def write_c99(guard: Guard, folder: Path, prefix: str = "evofsm") -> None:
    """Write ``evofsm.h``, ``evofsm.c``, and ``evofsm.hpp``, a class around them for C++17.

    With another prefix, files and all names in them begin with that: two guards in one program need
    two. A ValueError if its reviser or judge is of someone's own class, it judges nothing (mode
    off), nothing was learnt yet by which it could decide, or it was not shown to help.
    """
    is_name = re.fullmatch("[A-Za-z](_?[A-Za-z0-9])*(?<!_t)", prefix)
    if not is_name or {prefix, prefix.lower()} & {*_TAKEN.split()}:
        fault = f"the prefix {prefix!r} begins no name in C and C++, or is one of theirs"
        raise ValueError(f"{fault}: take letters, digits and single _, such as my_guard")
    texts = _texts(guard)
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as files:  # all are written before one takes its place
        for suffix in ("h", "hpp", "c"):
            text = texts[f"evofsm.{suffix}"].replace("EVOFSM", prefix.upper())
            place = files.enter_context(store.replacing(folder / f"{prefix}.{suffix}"))
            place.write(re.sub(r"evofsm(?! \d)", prefix, text).encode())
            place.flush()


def write_fmu(guard: Guard, file: Path) -> None:
    """Write an FMU (FMI 2.0, co-simulation), compiled where a C compiler is at hand.

    Its sources are in it, so that it can be built for others. A ValueError as of `write_c99`.
    """
    name = re.sub(r"^(?=\d)|\W", "_", file.stem, flags=re.ASCII)
    texts, library = _texts(guard, name), f"{name}.{_LIBRARIES.get(sys.platform, 'so')}"
    open_place = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # of what is loaded
    with open_place as place, store.replacing(file) as output:
        folder = Path(place)
        for file_name, text in texts.items():
            (folder / file_name).write_text(text, "utf-8")
        files = [folder / part for part in (library, "evofsm.c", "fmi2.c")]
        compiler, fault = os.environ.get("CC") or "cc", "it cannot be started"
        try:
            words = [compiler] if shutil.which(compiler) else shlex.split(compiler)
            code = subprocess.run([*words, *_FLAGS, "-o", *files, "-lm"], check=False).returncode
            fault = f"it ended with status {code}" if code else ""
            _ = fault or ctypes.CDLL(str(files[0]))
        except (OSError, ValueError) as error:
            if not fault and not re.search("to map|not permitted", str(error)):  # under noexec
                fault = str(error).removeprefix(f"{files[0]}: ")
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as unit:
            unit.write(folder / "modelDescription.xml", "modelDescription.xml")
            for file_name in ("evofsm.h", "evofsm.c", "fmi2.c"):
                unit.write(folder / file_name, f"sources/{file_name}")
            if not fault:
                binaries = f"binaries/{sys.platform.removesuffix('32')}64"
                unit.write(files[0], f"{binaries}/{library}")
            else:
                note = "%s holds sources alone: %s (CC, or cc) built no library that loads here: %s"
                logging.getLogger(__name__).warning(note, file, compiler, fault)


def _texts(guard: Guard, unit: str = "") -> dict[str, str]:
    """All files by their names; and of an FMU by its own."""
    frozen = guard.copy()
    frozen.freeze()
    reviser, judge_class = frozen.reviser, type(getattr(frozen.reviser, "risk", None))
    if type(reviser) is not ActionReviser or reviser.mode is Mode.OFF:
        kind = f"{type(reviser).__name__}{' in mode off' * hasattr(reviser, 'mode')}"
        text = "only a guard with an ActionReviser whose mode is not off is exported"
        raise ValueError(f"{text}, not one of {kind}")
    labels = reviser.risk.labels
    names, units = _told(labels.names), _told(labels.units)
    reviser.risk.labels = labels._replace(names=names, units=units)
    frozen.begin()
    if reviser.passing:
        fault = f"this guard {reviser.passing}: exported it would let all proposals pass"
        raise ValueError(f"{fault}; let it learn on, or set guard.shadow = False")
    if not reviser.acts:
        note = "exported in mode %s it watches: executed is always the proposal; --mode act filters"
        logging.getLogger(__name__).warning(note, reviser.mode.value)
    if judge_class is not LearntRisk and "in_c99" not in vars(judge_class):
        raise ValueError(f"a LearntRisk or a LatentRisk is exported, but no {judge_class.__name__}")
    part: Part = _learnt(reviser) if judge_class is LearntRisk else reviser.risk.in_c99(reviser)  # type: ignore[attr-defined]
    common, judge = _sections(Path(__file__).with_name("guard.c")), _sections(part.template)
    sizes, constants = _common(frozen, reviser, part.variables)
    sizes |= part.sizes
    sizes["STACK"] = _STACK + 64 * sizes.get("NUMBERS", 0) + 32 * sizes.get("LANES", 0)
    m, a = sizes["VARIABLES"], sizes["ACTIONS"]
    variables = ", ".join(names) or "variables in their order"
    about = visible(f"{frozen}\nan observation: {variables}\n{part.about}").replace("\n", "\n   ")
    values = constants["fallback"].tolist()
    starts = [*[0.0] * m, *values, *values, *[0.0] * 3]  # of an FMU, in the order of fmi2.c
    texts = {
        "TOOL": f"evofsm {__version__}",
        "ABOUT": re.sub("(?<=[*/?])(?=[*/?])", " ", about),  # neither a comment nor a trigraph
        "SIZES": _written({f"EVOFSM_{name}": value for name, value in sizes.items()}),
        "STATE": judge["state"],
        "CONSTANTS": _written({**constants, **part.constants}),
        "SOURCE": judge["source"],
        "NAME": unit,
        "STEP": repr(guard.interval),
        "FALLBACK": f"{', '.join(f'{value:g}' for value in values)} ({reviser.fallback.doing})",
        "START": _number(starts),
        "VARIABLES": _variables(names or range(m), starts, whole=sizes["CHOICES"] > 0),
        "OUTPUTS": "".join(f'<Unknown index="{m + a + k}"/>' for k in range(1, a + 4)),
    }
    texts["GUID"] = hashlib.sha256(f"{texts}{common}".encode()).hexdigest()
    texts["GUARD"] = f"0x{texts['GUID'][:8]}u"
    pattern = re.compile("UNIT_([A-Z]+)")
    return {of: pattern.sub(lambda found: texts[found[1]], text) for of, text in common.items()}


def _told(names: Sequence[str]) -> tuple[str, ...]:
    """Names in a line each; counted where two would be the same."""
    lines = tuple(map(in_a_line, names))
    if len(set(lines)) == len(lines):
        return lines
    return tuple(f"{k}: {line}" for k, line in enumerate(lines, start=1))


def _variables(names: Sequence[object], starts: Sequence[float], *, whole: bool) -> str:
    """Variables of an FMU for its description, in the order of ``fmi2.c``."""
    m, columns = len(names), [f"observation[{name}]" for name in names]
    a = (len(starts) - m - 3) // 2
    acts = [f"{act}[{i}]" for act in ("proposal", "executed") for i in range(a)]
    kinds = ["Real"] * m + ["Integer" if whole else "Real"] * (2 * a)
    kinds += ["Real", "Integer", "Boolean"]
    how = ['"input"'] * (m + a) + ['"output" initial="exact"'] * (a + 3)
    every = zip([*columns, *acts, "risk", "reason", "revised"], kinds, how, starts, strict=True)
    return "".join(
        f'    <ScalarVariable name={quoteattr(name)} valueReference="{k}" causality={causality} '
        f'variability="discrete"><{kind} start="{begin:.17g}"/></ScalarVariable>\n'
        for k, (name, kind, causality, begin) in enumerate(every)
    )


def _sections(template: Path) -> dict[str, str]:
    _, *parts = re.split(r"^/\* ==== (\S+) ==== \*/\n", template.read_text("utf-8"), flags=re.M)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _common(guard: Guard, reviser: ActionReviser, m: int) -> tuple[dict[str, Any], dict[str, Any]]:
    actions, model = guard.actions, guard._frozen
    low, high = (np.atleast_1d(end) for end in limits(actions))
    seen_from, seen_to = looping.ends_of(reviser.risk, m)
    sizes = {
        "VARIABLES": m,
        "ACTIONS": len(low),
        "CHOICES": actions.n_actions if isinstance(actions, Choices) else 0,
        "STATES": 0 if model is None else model.n_states,
        "INTERVAL": guard.interval,
    }
    constants: dict[str, Any] = {
        "ACTS": reviser.acts,
        "LONGEST_GAP": looping._GAP * guard.interval,
        "MOST_STALE": looping._STALE,
        "TOLERANCE": reviser.tolerance,
        **{name: getattr(revising, f"_{name}") for name in ("NEW", "RELEASE", "TRIAL")},
        **{"action_low": low, "action_high": high, "seen_from": seen_from, "seen_to": seen_to},
        "fallback": np.atleast_1d(put_into(actions, reviser.fallback.action)),
    }
    if model is not None and model.n_states:
        constants |= {
            "centers": model.centers,
            "centre_weights": weights_of(model.rule, m),
            "STATE_REACH": reach(model.rule, model.settings, model.width),
            "time_seen": model.visits * guard.interval,
        }
    return sizes, constants


def _learnt(reviser: ActionReviser) -> Part:
    risk: Any = reviser.risk
    state, parts = risk.state, risk.parts
    if parts is None or not state.knows_failure:
        raise ValueError(f"there is nothing to export yet: {risk.told_by_experience}")
    model, rest = parts.model, parts.residuals  # frozen, it doubts nothing
    (steps, rows, count), (p, m), a = rest.shape, model.weights.shape, risk.size
    lanes = -(-count // _LANES) * _LANES
    memory, soon = risk.remembered, risk._soon(risk.remembered.seconds)
    names = [f"{q}: {risk.backup_text(q)}" for q in range(len(state.policies))]
    n_queries = min(parts.n_asked, len(names))
    constants: dict[str, Any] = {
        "DISTURBANCES": count,
        "STEPS": steps,
        "CROSSED": rollout.crossed(m, a),
        "PAIRED": m if len(rollout.pairs(m)[0]) else 0,
        "FORMS": len(model.forms),
        "SCALE": parts.scale,
        "MARGIN": state.margin,
        "ALLOWED": risk._allowed(reviser.tolerance, memory),
        "ASKED": n_queries,
        "JUDGED": min(parts.n_judged, n_queries),
        "MOST_DONE": math.ceil(parts.most),
        "EVIDENCE": float(memory.number),
        "ENDS_SEEN": int(memory.lost[1] > 0),
        "BLIND": risk.BLIND,
        **{name.strip("_"): getattr(rollout, name) for name in _OF_ROLLOUTS},
        **{name: getattr(model, name) for name in _OF_MODEL},
        "dead_ends": model.dead_ends if len(model.dead_ends) else np.zeros((1, m + 2)),
        "residuals": rest[:, :, [*range(count), *[0] * (lanes - count)]],  # others are undisturbed
        "policies": state.policies,
        "usual": parts.usual,
        "risks": [risk._risk(n, soon) for n in (math.inf, *map(float, range(count)))],
        "middle": risk.middle,
        "half": risk.half,
    }
    most_rollouts = 2 * n_queries + max(parts.n_asked, rollout._HALVINGS) + 2 * parts.n_asked
    about = (
        f"backups: {'; '.join(names)}\n"
        f"a decision: at most {most_rollouts} "
        f"rollouts of {steps} steps, each of {p} x {m} products in {lanes} lanes\n"
    )
    sizes = {"NUMBERS": a, "FEATURES": p, "LANES": lanes, "BACKUPS": len(names)}
    sizes["STRIDE"] = state.stride
    sizes["DEAD_ENDS"], sizes["LANDS"] = len(model.dead_ends), int(rows > m)
    return Part(Path(rollout.__file__).with_suffix(".c"), m, sizes, constants, about)


# Constants of rollouts, and arrays of a model, that C has, too.
_OF_ROLLOUTS = ["_RESERVE", "_DISTANCE", "_FAR", "_HALVINGS", "ROUNDING", "NO_LONGER"]
_OF_ROLLOUTS += ["FLAT", "GROWN", "SHRUNK", "FAILS", "ENDS", "CRASHES"]
_OF_MODEL = (
    *("weights", "origin", "reach", "lowest", "highest", "least", "most", "forms"),
    *("mean", "inverse"),
)


def _written(constants: Mapping[str, Any]) -> str:
    numbers, arrays = "", ""
    for name, value in constants.items():
        if np.ndim(value) == 0:
            numbers += f"#define {name} {_number(value)}\n"
        elif np.size(value):
            kind = "int" if np.asarray(value).dtype.kind == "i" else "double"
            sides = "".join(f"[{size}]" for size in np.shape(value))
            arrays += f"\nstatic const {kind} {name}{sides} = {_number(value)};\n"
    return numbers + arrays


def _number(value: Any) -> str:
    """The shortest text that is this very number; of an array in braces."""
    if np.ndim(value):
        return "{" + (", " if np.ndim(value) == 1 else ",\n ").join(map(_number, value)) + "}"
    if isinstance(value, bool | int | np.integer):
        return str(int(value))
    names = {math.inf: "INFINITY", -math.inf: "(-INFINITY)"}
    return names.get(float(value), f"({float(value)!r})" if value < 0.0 else repr(float(value)))
