"""How fast it is, as ratios against named references in the same run.

Usage: python benchmarks/speed.py [--only batch_7,call_7] [--repeats 7] [--json bench.json]

Prints one table and writes it as JSON, and says which targets are missed. Fails where a row could
not be measured, or a ratio is worse than in an earlier JSON by more than a margin.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from fsm_rows import batch, call, cost_and_memory, db_stream, many_states, stream_k_means
from guard_rows import FIRST, first, kinematic_decision, learnt_decision
from timing import HEADER, Result, Row, judged, shown, worsened

_LAST = Path(__file__).with_name("last.json")


def late(module: str) -> Callable[[int, bool], Result]:
    """The `measure` of a module that is imported once it is called, and has no short sizes."""

    def measure(repeats: int, short: bool) -> Result:
        result: Result = importlib.import_module(module).measure(repeats)
        return result

    return measure


ROWS = {
    "batch_7": Row(partial(batch, 7), ">=", 110.0),
    "batch_64": Row(partial(batch, 64), ">=", 22.0),
    "call_7": Row(partial(call, 7), ">=", 5.0),
    "call_64": Row(partial(call, 64), ">="),
    "river_streamkmeans": Row(stream_k_means, ">=", 5.0),
    "river_dbstream": Row(db_stream, ">=", 6.0),
    "sumo_loop": Row(late("sumo_loop"), "<=", 1.25),
    "csv_learn": Row(late("csv_learn"), "<=", 3.0),
    "states_1024": Row(many_states, "<=", 20.0),
    "learnt_decision": Row(partial(learnt_decision, 0.5), "s", 0.23e-3),
    "learnt_p99": Row(partial(learnt_decision, 0.99), "s", 1.5e-3),
    "kinematic_p99": Row(kinematic_decision, "s", 1e-3),
    **{id_: Row(partial(first, id_), "s", most) for id_, (_, _, most) in FIRST.items()},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; 1 where a row failed or a ratio is worse than before."""
    options = parse(arguments)
    if options.table:
        print(cost_and_memory(options.repeats, options.short))
        return 0
    last = json.loads(options.against.read_text()) if options.against.exists() else []
    results, good = [], True
    print(HEADER)
    for number, id_ in enumerate(options.only, 1):
        print(f"measuring {id_} ({number} of {len(options.only)})", file=sys.stderr, flush=True)
        try:
            result = judged(id_, ROWS[id_], ROWS[id_].measure(options.repeats, options.short))
        except ImportError as error:
            print(f"{id_:<19} not installed: {error}\n", flush=True)
            good = False
        except Exception:  # the other rows, which take minutes, are not to be lost
            print(f"{id_:<19} not measured: it failed\n", flush=True)
            traceback.print_exc()
            good = False
        else:
            worse = None if options.short else worsened(result, last)
            print(shown(result, worse), flush=True)
            good = good and not worse
            results.append(result)
    options.json.write_text(json.dumps(results, indent=1) + "\n")
    return int(not good)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", type=ids, default=list(ROWS), help="ids of rows, with commas")
    parser.add_argument("--repeats", type=int, default=7, help="turns, of which the median counts")
    parser.add_argument("--json", type=Path, default=Path("bench.json"), help="where to write")
    parser.add_argument("--against", type=Path, default=_LAST, help="the JSON of an earlier run")
    parser.add_argument("--short", action="store_true", help="few rows: to see whether it runs")
    parser.add_argument("--table", action="store_true", help="cost and memory by states instead")
    return parser.parse_args(arguments)


def ids(text: str) -> list[str]:
    """The ids named, all of them known."""
    named = text.split(",")
    for id_ in named:
        if id_ not in ROWS:
            raise argparse.ArgumentTypeError(f"no row {id_!r}; there are {', '.join(ROWS)}")
    return named


if __name__ == "__main__":
    sys.exit(main())
