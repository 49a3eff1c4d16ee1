"""Where each array of a machine stands in its flat buffer, read from the annotations of tuples.

A tuple or dataclass that describes a part of the buffer (`memory.Memory`, and those in it) names a
kind for each field: an `Array` of the table (`evofsm.fsm.learnt`), or one of the types below.
Arrays of a kind lie one behind another, in the order of the fields. Python gets such parts with
NumPy views. Kernels get an `Opened` in their place: a handful of pointers and sizes, from which a
field is worked out where it is used. A tuple of forty arrays takes Numba half a minute to compile,
since each is eight numbers that are handed on at every call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeAlias,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
)
from numba.np import arrayobj
from numpy.typing import NDArray

from evofsm.fsm.kernels import NOT_COMPILED
from evofsm.store import Numbers

# Numba has no types for these.
_arrays, _codegen = cast(Any, arrayobj), cast(Any, cgutils)

Floats: TypeAlias = NDArray[np.float64]
Setting: TypeAlias = Annotated[float, "setting"]  #: a number that a machine was told
PerState: TypeAlias = Annotated[Floats, "state"]  #: (capacity,)
PerVariable: TypeAlias = Annotated[Floats, "variable"]  #: (m,)
AllPerState: TypeAlias = Annotated[Floats, "state", "all"]  #: (all of the kind, capacity)
AllPerPlace: TypeAlias = Annotated[Floats, "place", "all"]  #: (all, places, capacity)

#: The shape of an array of each kind, in the order in which they lie in a buffer.
SHAPES: dict[str, tuple[str, ...]] = {
    "counter": ("one",),
    "state": ("capacity",),
    "center": ("m", "capacity"),
    "change": ("capacity", "capacity"),
    "place": ("places", "capacity"),
    "action": ("q",),
    "variable": ("m",),
    "matrix": ("places", "capacity", "capacity"),
}
SIZES = ("m", "q", "capacity", "places")


@dataclass(frozen=True, eq=False)
class Array:
    """One array of what is learnt: all that any room has to know of it.

    As an attribute of a machine or a model it is the array itself.
    """

    kind: str  #: a key of `SHAPES`
    range: Numbers  #: of its numbers
    #: What becomes of it as two states are joined, and in a state that is given up: the sum, or
    #: the larger of both, and 0; or else it is set where that is done.
    joined_by: Literal["sum", "most", "hand"] = "hand"
    #: Name of the array with the time of the latest of what is counted here: what belongs to the
    #: episode that is going on is not shown yet.
    latest: str = ""
    name: str = ""

    def __set_name__(self, owner: type, name: str) -> None:
        object.__setattr__(self, "name", self.name or name)

    def __get__(self, known: Any, owner: type | None = None) -> Any:
        return self if known is None else known._array(self)


class Place(NamedTuple):
    """Where a field stands: among those of its kind, from 0; `ALL` for all of them as one."""

    kind: str
    number: int


ALL = -1
#: The fields of each part: where it stands, or the part that it is.
FIELDS: dict[type, dict[str, Place | type]] = {}
#: Where each array of the table stands.
PLACES: dict[Array, Place] = {}
#: How many arrays there are of each kind, and settings.
COUNTS: dict[str, int] = {"setting": 0} | dict.fromkeys(SHAPES, 0)


def number_fields(kind: type) -> None:
    """Give each field of a part, and of the parts in it, its place."""
    fields = FIELDS.setdefault(kind, {})
    for name, told in get_type_hints(kind, include_extras=True).items():
        array = getattr(kind, name, None)
        if isinstance(array, Array):
            fields[name] = PLACES[array] = _next(array.kind)
        elif get_origin(told) is not Annotated:
            fields[name] = told
            number_fields(told)
        elif "all" in (tags := get_args(told)[1:]):
            fields[name] = Place(tags[0], ALL)
        else:
            fields[name] = _next(tags[0])


def _next(kind: str) -> Place:
    COUNTS[kind] += 1
    return Place(kind, COUNTS[kind] - 1)


def joined_by(way: str, kind: str) -> tuple[int, ...]:
    """Which of the arrays of a kind are joined in a way, by number."""
    return tuple(
        place.number
        for array, place in PLACES.items()
        if (array.joined_by, array.kind) == (way, kind)
    )


def build(kind: type, value: Callable[[Place], Any]) -> Any:
    """A part with a value for each field that has a place."""
    return kind(
        **{
            name: value(field) if isinstance(field, Place) else build(field, value)
            for name, field in FIELDS[kind].items()
        }
    )


# -- For kernels ----------------------------------------------------------------------------------


class Opened(types.Type):
    """A part of a buffer, as a kernel sees it: `kind` is the tuple that it stands for."""

    def __init__(self, kind: type, matrices: Any) -> None:
        self.kind = kind
        self.matrices = matrices
        super().__init__(f"Opened({kind.__name__}, {matrices})")

    def field(self, name: str) -> Any:
        """The type of a field; None if there is none of that name."""
        told = FIELDS[self.kind].get(name)
        if told is None:
            return None
        if isinstance(told, type):
            return Opened(told, self.matrices)
        if told.kind == "setting":
            return types.float64
        number = self.matrices if told.kind == "matrix" else types.float64
        return types.Array(number, len(SHAPES[told.kind]) + (told.number == ALL), "C")


@register_model(Opened)
class _OpenedModel(models.StructModel):
    def __init__(self, manager: Any, opened: Any) -> None:
        pointers = dict.fromkeys(["setting", *SHAPES], types.CPointer(types.float64))
        pointers["matrix"] = types.CPointer(opened.matrices)
        members = [*pointers.items(), *((size, types.intp) for size in SIZES)]
        cast(Any, super()).__init__(manager, opened, members)


@infer_getattr
class _OpenedFields(AttributeTemplate):
    key = Opened

    def generic_resolve(self, opened: Any, name: str) -> Any:  # type: ignore[override]
        return opened.field(name)


def _lower_field(context: Any, builder: Any, opened: Any, value: Any, name: str) -> Any:
    told = FIELDS[opened.kind][name]
    if isinstance(told, type):
        return value
    within = _codegen.create_struct_proxy(opened)(context, builder, value=value)
    if told.kind == "setting":
        return builder.load(
            builder.gep(within.setting, [context.get_constant(types.intp, told.number)])
        )
    one = context.get_constant(types.intp, 1)
    lengths = [one if size == "one" else getattr(within, size) for size in SHAPES[told.kind]]
    start = context.get_constant(types.intp, max(told.number, 0))
    if told.number == ALL:
        lengths.insert(0, context.get_constant(types.intp, COUNTS[told.kind]))
    strides: list[Any] = []
    kind = opened.field(name)
    stride = context.get_constant(types.intp, kind.dtype.bitwidth // 8)
    for length in reversed(lengths):
        start = builder.mul(start, length)
        strides.insert(0, stride)
        stride = builder.mul(stride, length)
    array = _arrays.make_array(kind)(context, builder)
    _arrays.populate_array(
        array,
        data=builder.gep(getattr(within, told.kind), [start]),
        shape=lengths,
        strides=strides,
        itemsize=context.get_constant(types.intp, kind.dtype.bitwidth // 8),
        meminfo=None,
    )
    return array._getvalue()


cast(Any, lower_getattr_generic)(Opened)(_lower_field)


def opener(kind: type, in_python: Callable[..., Any]) -> Any:
    """``opened(buffer, matrices, sizes, begins)``, for kernels: see `memory.open_apart`.

    ``begins`` has the place of the first setting, and of the first array of each kind. Where
    Numba is switched off (``NUMBA_DISABLE_JIT``), it is the function for Python.
    """
    if NOT_COMPILED:
        return in_python

    @intrinsic
    def opened(_context: Any, buffer: Any, matrices: Any, sizes: Any, begins: Any) -> Any:
        result = Opened(kind, matrices.dtype)

        def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
            made = _codegen.create_struct_proxy(result)(context, builder)
            data, of_matrices = (
                _arrays.make_array(array)(context, builder, value).data
                for array, value in zip((buffer, matrices), arguments[:2], strict=True)
            )
            for name, size in zip(SIZES, _codegen.unpack_tuple(builder, arguments[2]), strict=True):
                setattr(made, name, size)
            starts = _codegen.unpack_tuple(builder, arguments[3])
            for name, start in zip(["setting", *SHAPES], starts, strict=True):
                if name != "matrix":
                    setattr(made, name, builder.gep(data, [start]))
            made.matrix = of_matrices
            return made._getvalue()

        return result(buffer, matrices, sizes, begins), generate

    return opened
