"""Where each array of a machine stands in its flat buffer, read from the annotations of tuples.

A tuple that describes a part of the buffer (`memory.Memory`, and those in it) annotates its fields
with the types below; arrays of a kind lie one behind another, in the order of the tuples. Python
gets such tuples of NumPy views. Kernels get an `Opened` in their place: a handful of pointers and
sizes, from which a field is worked out where it is used. A tuple of forty arrays takes Numba half
a minute to compile, since each is eight numbers that are handed on at every call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any, NamedTuple, TypeAlias, cast, get_args, get_origin, get_type_hints

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

# Numba has no types for these.
_arrays, _codegen = cast(Any, arrayobj), cast(Any, cgutils)

_Array: TypeAlias = NDArray[np.float64]
Setting: TypeAlias = Annotated[float, "setting"]  #: a number that a machine was told
Counter: TypeAlias = Annotated[_Array, "counter"]  #: (1,)
PerState: TypeAlias = Annotated[_Array, "state"]  #: (capacity,)
Centers: TypeAlias = Annotated[_Array, "center"]  #: (m, capacity)
Changes: TypeAlias = Annotated[_Array, "change"]  #: (capacity, capacity)
PerPlace: TypeAlias = Annotated[_Array, "place"]  #: (places, capacity)
PerAction: TypeAlias = Annotated[_Array, "action"]  #: (q,)
PerVariable: TypeAlias = Annotated[_Array, "variable"]  #: (m,)
Matrices: TypeAlias = Annotated[_Array, "matrix"]  #: (places, capacity, capacity)

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


class Place(NamedTuple):
    """Where a field stands: among those of its kind, from 0."""

    kind: str
    number: int


#: The fields of each tuple: where it stands, or the tuple that it is.
FIELDS: dict[type, dict[str, Place | type]] = {}


def number_fields(kind: type) -> dict[str, int]:
    """Give each field of a tuple, and of the tuples in it, its place; how many of a kind."""
    counts = {"setting": 0} | dict.fromkeys(SHAPES, 0)
    for name, told, fields in _walk(kind):
        if get_origin(told) is Annotated:
            of_kind = get_args(told)[1]
            fields[name] = Place(of_kind, counts[of_kind])
            counts[of_kind] += 1
        else:
            fields[name] = told
    return counts


def _walk(kind: type) -> Iterator[tuple[str, Any, dict[str, Place | type]]]:
    fields = FIELDS.setdefault(kind, {})
    for name, told in get_type_hints(kind, include_extras=True).items():
        yield name, told, fields
        if get_origin(told) is not Annotated:
            yield from _walk(told)


def build(kind: type, value: Callable[[Place], Any]) -> Any:
    """A tuple with a value for each field that has a place."""
    return kind(
        *(
            value(field) if isinstance(field, Place) else build(field, value)
            for field in FIELDS[kind].values()
        )
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
        return types.Array(number, len(SHAPES[told.kind]), "C")


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
    start = context.get_constant(types.intp, told.number)
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


def opener(kind: type) -> Any:
    """``opened(buffer, matrices, sizes, begins)``, for kernels: see `memory.open_apart`.

    ``begins`` has the place of the first setting, and of the first array of each kind.
    """

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
