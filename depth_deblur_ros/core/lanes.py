"""
Sixteen float32 side by side, for compiled kernels.

A loop that reads an image at places known only when it runs is not turned into vector code by
the compiler. With these a kernel says so itself: load and store sixteen neighbours, and + - * /
on all of them at once. Where registers are narrower, the compiler takes several. Indices count
from the start of a contiguous array and are not checked.
"""

from __future__ import annotations

from collections.abc import Callable
import operator
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
import numpy as np

WIDTH = 16
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_INDEX = ir.IntType(32)
_NOTHING = ir.Constant(_VECTOR, ir.Undefined)
_instruction: Any = intrinsic


def whole_blocks(size: int) -> int:
    """Round a width up to whole blocks."""
    return -(-size // WIDTH) * WIDTH


class Lanes(types.Type):
    """The compiler's type of sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name='Lanes')


LANES = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)  # type: ignore[no-untyped-call]


def _fits(array: Any, kind: Any = types.float32) -> bool:
    return bool(array.dtype == kind and array.layout == 'C' and array.ndim == 1)


def _address(context: Any, builder: Any, kinds: Any, values: Any, kind: Any = _VECTOR) -> Any:
    array = context.make_array(kinds[0])(context, builder, value=values[0])
    return builder.bitcast(builder.gep(array.data, [values[1]]), kind.as_pointer())


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
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Let an element of a contiguous float32 array come nearer the core; it need not exist."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _address(context, builder, signature.args, values, ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [place.type, *[_INDEX] * 3])
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, kind, 'llvm.prefetch.p0'
        )
        builder.call(function, [place, _INDEX(0), _INDEX(2), _INDEX(1)])
        return context.get_dummy_value()

    return (types.void(array, types.intp), build) if _fits(array) else None


_SHORTS = ir.VectorType(ir.IntType(16), WIDTH)


@_instruction  # type: ignore[untyped-decorator]
def load_whole(typing: Any, array: Any, index: Any) -> Any:
    """Read the elements index to index + 15 of a contiguous uint16 array as float32."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _address(context, builder, signature.args, values, _SHORTS)
        found = builder.zext(builder.load(place, align=2), ir.VectorType(_INDEX, WIDTH))
        return builder.sitofp(found, _VECTOR)

    return (LANES(array, types.intp), build) if _fits(array, types.uint16) else None


@_instruction  # type: ignore[untyped-decorator]
def store_whole(typing: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Write values of 0 to 65535, less what follows the point, to a contiguous uint16 array."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _address(context, builder, signature.args, values, _SHORTS)
        found = builder.fptosi(values[2], ir.VectorType(_INDEX, WIDTH))
        builder.store(builder.trunc(found, _SHORTS), place, align=2)
        return context.get_dummy_value()

    fits = _fits(array, types.uint16)
    return (types.void(array, types.intp, LANES), build) if fits else None


@_instruction  # type: ignore[untyped-decorator]
def splat(typing: Any, value: Any) -> Any:
    """Give sixteen times one float32."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        first = builder.insert_element(_NOTHING, values[0], _INDEX(0))
        return builder.shuffle_vector(first, _NOTHING, _order([0] * WIDTH))

    return LANES(types.float32), build


@_instruction  # type: ignore[untyped-decorator]
def next_lane(typing: Any, lanes: Any, before: Any) -> Any:
    """Move each value to the next lane; the first gets the last one of those before."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        order = _order(list(range(WIDTH - 1, 2 * WIDTH - 1)))
        return builder.shuffle_vector(values[1], values[0], order)

    return LANES(LANES, LANES), build


@_instruction  # type: ignore[untyped-decorator]
def last_lane(typing: Any, lanes: Any) -> Any:
    """Give the value of the last lane."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.extract_element(values[0], _INDEX(WIDTH - 1))

    return types.float32(LANES), build


def _first_of_all(sign: str) -> Any:
    """Make a function that gives the value that stands first by < or >."""

    @_instruction  # type: ignore[untyped-decorator]
    def reduce(typing: Any, lanes: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            best, half = values[0], WIDTH // 2
            while half:
                other = builder.shuffle_vector(
                    best, _NOTHING, _order([(k + half) % WIDTH for k in range(WIDTH)])
                )
                best = builder.select(builder.fcmp_ordered(sign, best, other), best, other)
                half //= 2
            return builder.extract_element(best, _INDEX(0))

        return types.float32(LANES), build

    return reduce


least, greatest = _first_of_all('<'), _first_of_all('>')


@_instruction  # type: ignore[untyped-decorator]
def pairs(typing: Any, array: Any, places: Any) -> Any:
    """Read the elements i and i + 1 for sixteen i, whole numbers >= 0 as float32: two lanes."""
    both = types.UniTuple(LANES, 2)  # type: ignore[no-untyped-call]

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        flat = context.make_array(signature.args[0])(context, builder, value=values[0])
        long = ir.VectorType(ir.IntType(64), WIDTH)
        first = builder.ptrtoint(flat.data, ir.IntType(64))
        first = builder.insert_element(ir.Constant(long, ir.Undefined), first, _INDEX(0))
        first = builder.shuffle_vector(first, first, _order([0] * WIDTH))
        bytes_on = builder.mul(builder.fptosi(values[1], long), ir.Constant(long, [4] * WIDTH))
        addresses = builder.inttoptr(
            builder.add(first, bytes_on), ir.VectorType(ir.DoubleType().as_pointer(), WIDTH)
        )
        kind = ir.VectorType(ir.DoubleType(), WIDTH)  # two float32 in one read
        mask = ir.Constant(ir.VectorType(ir.IntType(1), WIDTH), [True] * WIDTH)
        name = f'llvm.masked.gather.v{WIDTH}f64.v{WIDTH}p0'
        arguments = [addresses, _INDEX(4), mask, ir.Constant(kind, ir.Undefined)]
        gather = ir.FunctionType(kind, [value.type for value in arguments])
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, gather, name
        )
        found = builder.call(function, arguments)
        found = builder.bitcast(found, ir.VectorType(ir.FloatType(), 2 * WIDTH))
        halves = [
            builder.shuffle_vector(found, found, _order(list(range(k, 2 * WIDTH, 2))))
            for k in (0, 1)
        ]
        return context.make_tuple(builder, both, halves)

    return (both(array, LANES), build) if _fits(array) else None


@_instruction  # type: ignore[untyped-decorator]
def whole(typing: Any, lanes: Any) -> Any:
    """Cut off what follows the point."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        numbers = builder.fptosi(values[0], ir.VectorType(_INDEX, WIDTH))
        return builder.sitofp(numbers, _VECTOR)

    return LANES(LANES), build


@_instruction  # type: ignore[untyped-decorator]
def bits_of(typing: Any, value: Any) -> Any:
    """Take the bits of one float32 as a whole number."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.bitcast(values[0], _INDEX)

    return types.int32(types.float32), build


@_instruction  # type: ignore[untyped-decorator]
def of_bits(typing: Any, value: Any) -> Any:
    """Take a whole number as the bits of one float32."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.bitcast(values[0], ir.FloatType())

    return types.float32(types.int32), build


@_instruction  # type: ignore[untyped-decorator]
def where_positive(typing: Any, sign: Any, a: Any, b: Any) -> Any:
    """Give a where sign > 0, else b."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        zeros = ir.Constant(_VECTOR, [0.0] * WIDTH)
        return builder.select(builder.fcmp_ordered('>', values[0], zeros), *values[1:])

    return LANES(LANES, LANES, LANES), build


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
larger = _of_two(lambda builder, a, b: builder.select(builder.fcmp_ordered('>', a, b), a, b))
smaller = _of_two(lambda builder, a, b: builder.select(builder.fcmp_ordered('<', a, b), a, b))


def _stands_for(sign: Any, instruction: str) -> None:
    """Let a sign between two lanes mean an instruction."""

    def generic(self: Any, kinds: Any, _: Any) -> Any:
        if kinds != (LANES, LANES):
            return None
        return signature(LANES, LANES, LANES)  # type: ignore[no-untyped-call]

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return getattr(builder, instruction)(*values, flags=FAST)

    chosen = type(instruction, (AbstractTemplate,), {'generic': generic})
    infer_global(sign)(chosen)  # type: ignore[no-untyped-call]
    lower_builtin(sign, Lanes, Lanes)(build)  # type: ignore[no-untyped-call]


_stands_for(operator.add, 'fadd')
_stands_for(operator.iadd, 'fadd')
_stands_for(operator.sub, 'fsub')
_stands_for(operator.mul, 'fmul')
_stands_for(operator.truediv, 'fdiv')


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
