"""`evofsm bench`: a command for every study, made from the study's own fields."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from importlib.util import find_spec
from inspect import Parameter, Signature, cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_type_hints

from evofsm.app import PAGE, command_line, counter, plain_errors, print_json, progress, require
from evofsm.evidence.cli.leaders import leaders
from evofsm.evidence.studies import STUDIES
from evofsm.evidence.study import Study

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

with suppress(ModuleNotFoundError):
    import typer


def bench() -> typer.Typer:
    """The studies that hold ours against others."""
    app = typer.Typer(
        name="bench",
        help="Studies: ours against the baselines, on held-out scenarios.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(lambda: None)
    for study in (one for one in STUDIES.values() if one.group):
        app.command(name=study.id)(command_of(study))
    app.command(name="leaders")(leaders)
    return app


def command_of(study: type[Study[Any]]) -> Callable[..., None]:
    """The command of a study: its options are those of its fields, and those that all have."""

    @plain_errors
    def command(workers: int | None, short: bool, out: Path, as_json: bool, **given: Any) -> None:
        require(**study.needed, **({} if as_json else PAGE))
        plan = study(**given)
        _do(plan.shortened() if short else plan, workers, out, as_json=as_json)

    command.__doc__ = cleandoc(study.__doc__ or "")
    cast(Any, command).__signature__ = Signature(list(_parameters(study)))
    command.__annotations__ = {}
    return command


def _parameters(study: type[Study[Any]]) -> Iterator[Parameter]:
    hints = get_type_hints(study)
    for one in fields(study):
        if told := one.metadata:
            names = (told["name"],) if told["name"] else ()
            default = Parameter.empty if told["required"] else one.default
            made = _option(told["about"], *names, **told["limits"])
            yield _parameter(one.name, hints[one.name], made, default)
    out = Path(f"evofsm-{study.id}")
    every: dict[str, tuple[Any, Any, Any]] = {
        "workers": (int | None, _option("Processes. [default: one per core]", min=1), None),
        "short": (bool, _option(study.short, "--short"), False),
        "out": (Path, _option("Folder for the page, its figures and the data."), out),
        "as_json": (bool, _option("Print all rows as JSON; write nothing.", "--json"), False),
    }
    yield from (_parameter(name, *told) for name, told in every.items())


def _option(about: str, *names: str, **limits: Any) -> Any:
    return typer.Option(*names, help=about, **limits)


def _parameter(name: str, kind: Any, made: Any, default: Any) -> Parameter:
    annotation = Annotated[kind, made]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _do(study: Study[Any], workers: int | None, out: Path, *, as_json: bool) -> None:
    """Print the rows as JSON, or write the page with its figures and print what it says."""
    with progress() as bars:
        found = study.run(counter(bars, study.doing), workers)
    if as_json:
        print_json(found.frame.as_dicts())
        return
    from evofsm.app import console, to_json
    from evofsm.evidence.report.chapter import write_chapters

    out.mkdir(parents=True, exist_ok=True)
    with progress() as bars:
        chapter = study.chapter(found, out, command_line(), counter(bars, "Drawing figures"))
    (out / f"{study.id}.json").write_text(f"{to_json(study.document(found))}\n", encoding="utf-8")
    if find_spec("polars"):
        found.frame.write_parquet(out / f"{study.id}.parquet")
    page = write_chapters(out / "index.html", [chapter], command=command_line())
    screen = console()
    study.say(screen, found, chapter)
    screen.print(f"Page with all figures: {page}", soft_wrap=True)
