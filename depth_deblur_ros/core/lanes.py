"""
Sixteen float32 side by side, for compiled kernels.

A loop that reads an image at places known only when it runs is not turned into vector code by
the compiler. With these a kernel says so itself: load and store sixteen neighbours, and + - * on
all of them at once. Where registers are narrower, the compiler takes several. Indices count from
the start of a contiguous array and are not checked.
"""

from __future__ import annotations

from collections.abc import Callable
import operator
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, models, overload, register_model
import numpy as np

WIDTH = 16
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_INDEX = ir.IntType(32)
_NOTHING = ir.Constant(_VECTOR, ir.Undefined)
_instruction: Any = intrinsic


class Lanes(types.Type):
    """The compiler's type of sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name='Lanes')


LANES = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)  # type: ignore[no-untyped-call]


def _fits(array: Any) -> bool:
    return bool(array.dtype == types.float32 and array.layout == 'C' and array.ndim == 1)


def _address(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    array = context.make_array(kinds[0])(context, builder, value=values[0])
    return builder.bitcast(builder.gep(array.data, [values[1]]), _VECTOR.as_pointer())


@_instruction  # type: ignore[untyped-decorator]
def load(typing: Any, array: Any, index: Any) -> Any:
    """Read the elements index to index + 15 of a contiguous float32 array."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(_address(context, builder, signature.args, values), align=4)

    return (LANES(array, types.intp), build) if _fits(array) else None


@_instruction  # type: ignore[untyped-decorator]
def store(typing: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Write the elements index to index + 15 of a contiguous float32 array."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _address(context, builder, signature.args, values)
        builder.store(values[2], place, align=4)
        return context.get_dummy_value()

    return (types.void(array, types.intp, LANES), build) if _fits(array) else None


@_instruction  # type: ignore[untyped-decorator]
def splat(typing: Any, value: Any) -> Any:
    """Give sixteen times one float32."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        first = builder.insert_element(_NOTHING, values[0], _INDEX(0))
        return builder.shuffle_vector(first, _NOTHING, _order([0] * WIDTH))

    return LANES(types.float32), build


@_instruction  # type: ignore[untyped-decorator]
def next_lane(typing: Any, lanes: Any) -> Any:
    """Move each value to the next lane; the first gets 0, the last one's is lost."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        zeros = ir.Constant(_VECTOR, [0.0] * WIDTH)
        return builder.shuffle_vector(values[0], zeros, _order([WIDTH, *range(WIDTH - 1)]))

    return LANES(LANES), build


@_instruction  # type: ignore[untyped-decorator]
def last_lane(typing: Any, lanes: Any) -> Any:
    """Give the value of the last lane."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.extract_element(values[0], _INDEX(WIDTH - 1))

    return types.float32(LANES), build


def _order(places: list[int]) -> Any:
    return ir.Constant(ir.VectorType(_INDEX, WIDTH), places)


def _of_two(calculate: Callable[[Any, Any, Any], Any]) -> Any:
    """Make a function of two lanes from what builds its instruction."""

    @_instruction  # type: ignore[untyped-decorator]
    def both(typing: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return calculate(builder, *values)

        return LANES(LANES, LANES), build

    return both


FAST = ('fast',)  # lets a * b + c become one instruction
_add = _of_two(lambda builder, a, b: builder.fadd(a, b, flags=FAST))
_subtract = _of_two(lambda builder, a, b: builder.fsub(a, b, flags=FAST))
_multiply = _of_two(lambda builder, a, b: builder.fmul(a, b, flags=FAST))
larger = _of_two(lambda builder, a, b: builder.select(builder.fcmp_ordered('>', a, b), a, b))
smaller = _of_two(lambda builder, a, b: builder.select(builder.fcmp_ordered('<', a, b), a, b))


def _stands_for(sign: Any, function: Any) -> None:
    """Let a sign between two lanes mean a function of them."""

    @overload(sign)
    def choose(a, b):  # type: ignore[no-untyped-def]
        def both(a, b):  # type: ignore[no-untyped-def]
            return function(a, b)

        return both if isinstance(a, Lanes) and isinstance(b, Lanes) else None


_stands_for(operator.add, _add)
_stands_for(operator.iadd, _add)
_stands_for(operator.sub, _subtract)
_stands_for(operator.mul, _multiply)


@njit(cache=True, nogil=True, inline='always')
def tent(distance):  # type: ignore[no-untyped-def]
    """Give max(0, 1 - |distance|), the weight of linear interpolation."""
    zero = splat(np.float32(0))
    return larger(zero, splat(np.float32(1)) - larger(distance, zero - distance))


@njit(cache=True, nogil=True, inline='always')
def total(lanes, room):  # type: ignore[no-untyped-def]
    """Give the sum of the lanes; room (16,) float32 is written."""
    store(room, 0, lanes)
    s = np.float32(0)
    for k in range(WIDTH):
        s += room[k]
    return s
