"""Products of sparse matrix rows with vectors of four numbers per vertex, in LLVM vectors.

An entry multiplies one vector load.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.llvm_vectors import I32, I64, VectorBuilder, unpack_arguments


def _sparse_row_product_code(typingctx: Any, values: Any, columns: Any, begin: Any, end: Any, x: Any) -> Any:
    """Return the sum of values[e] x[columns[e]] over begin <= e < end.

    The sum consists of four numbers of x's type.
    """
    number = x.dtype
    declared = types.UniTuple(number, 4)(values, columns, types.int64, types.int64, x)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values, columns, begin, end, x = unpack_arguments(context, builder, signature, args)
        v, row = VectorBuilder(context, builder), ir.VectorType(context.get_data_type(number), 4)
        total = cgutils.alloca_once_value(builder, ir.Constant(row, None))
        with cgutils.for_range_slice(builder, begin, end, I64(1), intp=I64) as (e, _):
            place = builder.mul(builder.sext(builder.load(builder.gep(columns, [e])), I64), I64(4))
            value = v.broadcast_scalar(builder.load(builder.gep(values, [e])), 4)
            source = v.load(builder.gep(x, [place]), row)
            builder.store(v.multiply_add(value, source, builder.load(total)), total)
        result = builder.load(total)
        parts = [builder.extract_element(result, I32(k)) for k in range(4)]
        return context.make_tuple(builder, signature.return_type, parts)

    return declared, generate


# Numba passes the first argument itself, which type checkers cannot see.
sparse_row_product: Any = intrinsic(_sparse_row_product_code)
