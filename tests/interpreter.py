"""Makes Triton's interpreter faster: it omits repeated and useless work. Kernels compute the same results."""

import functools
import inspect
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np


def spare_repeated_work():
    """For the rest of this process (Triton 3.6 to 3.9). More than half of the kernels' time goes there without it."""
    from triton import language
    from triton.runtime import interpreter

    builder = interpreter.interpreter_builder
    if not builder.options.debug:  # seven operations on each sum of integers, for a condition that only debug looks at
        builder.options = replace(builder.options, sanitize_overflow=False)
    _patch_once(interpreter, {language, language.core})
    find, found = interpreter._get_np_dtype, {}

    def np_dtype(dtype):
        """Of a type of the language; the interpreter makes a table of all of them at each call."""
        if dtype.name not in found:
            found[dtype.name] = find(dtype)
        return found[dtype.name]

    interpreter._get_np_dtype = np_dtype
    interpreter.TensorHandle.__post_init__ = lambda _: None  # compares sizes of types
    unwrap = language.core._unwrap_if_constexpr
    plain = {language.tensor, language.dtype, int, float, bool, str, type(None)}

    def unwrapped(value):
        if type(value) in plain:
            return value
        return value.value if type(value) is language.constexpr else unwrap(value)

    language.core._unwrap_if_constexpr = unwrapped
    _remember_builtins(interpreter, language.core)
    _remember_shapes(language.core, language.semantic.TritonSemantic)
    _remember_constants(language.core, language.semantic.TritonSemantic)


def _patch_once(interpreter, languages):
    """Leaves the interpreter's functions in the language. Putting them there for each launch, and for each call of a
    function in it, takes a twentieth of the kernels' time."""
    patch, patched, kept = interpreter._patch_lang, set(), SimpleNamespace(restore=lambda: None)

    @functools.cache
    def patch_lang(function):
        """The scope that ends with the launch."""
        seen = languages.intersection(each for each in function.__globals__.values() if isinstance(each, ModuleType))
        if not seen or not seen <= patched:
            patch(function)
            patched.update(seen)
        return kept

    interpreter._patch_lang = patch_lang


def _remember_builtins(interpreter, core):
    """Of the language, which the interpreter looks for and wraps again at each launch."""

    def wrapped(function):
        function = getattr(function, "__wrapped__", function)  # which looks for _semantic among the arguments first

        def builtin(*args, **kwargs):
            kwargs["_semantic"] = interpreter.interpreter_semantic
            return function(*args, **kwargs)

        return builtin

    @functools.cache
    def builtins_of(package):
        members = inspect.getmembers(package)
        return [(name, wrapped(member)) for name, member in members if core.is_builtin(member)]

    def patch_builtin(package, builder, scope):
        for name, member in builtins_of(package):
            scope.set_attr(package, name, member)

    interpreter._patch_builtin = patch_builtin


def _remember_constants(core, semantic):
    """Numbers beside a tensor, which the language makes blocks of for each operation. Operands of one type need no
    conversion, nor have a pointer and a whole number; all other operands go the language's own way."""
    check, integers = semantic.binary_op_type_checking_impl, (core.int32, core.int64)
    constants: dict[tuple[Any, ...], Any] = {}
    results: dict[tuple[str, str], Any] = {}

    def constant(self, value, beside):
        key = value, type(value), beside.type.name
        if key not in constants:
            scalar = self.scalar_constant(value, beside.type.scalar)
            constants[key] = self.broadcast_impl_value(beside, scalar)[1]
        return constants[key]

    def offset(self, value):
        if value not in constants:
            constants[value] = self.scalar_constant(value, core.int32)
        return constants[value]

    def wider(left, right):
        """The type of a result that has both shapes and the first one's numbers; None: the first one."""
        key = left.name, right.name
        if key not in results:
            shapes = [tuple(each.shape) if each.is_block() else () for each in (left, right)]
            shape = np.broadcast_shapes(*shapes)
            results[key] = None if shape == shapes[0] else core.block_type(left.scalar, list(shape))
        return results[key]

    def operands(self, lhs, rhs, allow_lhs_ptr=False, allow_rhs_ptr=False, arithmetic_check=True, div_or_mod=False):
        if type(lhs) is core.tensor and arithmetic_check and not div_or_mod:
            left = lhs.type.scalar
            if type(rhs) is core.tensor:
                right = rhs.type.scalar
                pointer = left.is_ptr()
                if (left is right and not pointer) or (pointer and allow_lhs_ptr and right.is_int()):
                    # NumPy broadcasts the operands, and the result has the first one's type
                    wide = wider(lhs.type, rhs.type)
                    return (lhs if wide is None else core.tensor(lhs.handle, wide)), rhs
            elif type(rhs) is float:
                if left.is_floating():
                    return lhs, constant(self, rhs, lhs)
            elif type(rhs) is int and -(2**31) <= rhs < 2**31:
                if left.is_ptr() and allow_lhs_ptr:
                    return lhs, offset(self, rhs)
                if left.is_floating() or left in integers:
                    return lhs, constant(self, rhs, lhs)
        return check(self, lhs, rhs, allow_lhs_ptr, allow_rhs_ptr, arithmetic_check, div_or_mod)

    semantic.binary_op_type_checking_impl = operands


def _remember_shapes(core, semantic):
    """Of tensors and their types, which the language wraps number by number for each result; of two tensors of one
    shape none is broadcast."""
    from triton.runtime.interpreter import TensorHandle

    block_init, tensor_init, broadcast = core.block_type.__init__, core.tensor.__init__, semantic.broadcast_impl_value
    with_element_ty, block_types = core.block_type.with_element_ty, {}
    blocks: dict[tuple[int, ...], tuple[Any, int, str]] = {}
    tensors: dict[int, tuple[Any, Any, Any]] = {}  # by the identity of a type's shape

    def init_block(self, element_ty, shape):
        key = tuple(one.value if isinstance(one, core.constexpr) else one for one in shape)
        if key in blocks:
            self.element_ty = element_ty
            self.shape, self.numel, begin = blocks[key]
            self.name = f"{begin}{element_ty}>"
        else:
            block_init(self, element_ty, shape)
            blocks[key] = self.shape, self.numel, self.name.removesuffix(f"{element_ty}>")

    def init_tensor(self, handle, type):
        key = id(type.shape) if type.is_block() else 0
        if key in tensors:
            self.handle, self.type, self.dtype = handle, type, type.scalar
            self.shape, self.numel, _ = tensors[key]
        else:
            tensor_init(self, handle, type)
            tensors[key] = self.shape, self.numel, type

    def block_of(self, scalar_ty):
        key = self.name, scalar_ty.name
        if key not in block_types:
            block_types[key] = with_element_ty(self, scalar_ty)
        return block_types[key]

    def splat(scalar, block):
        data = np.full(tuple(block.shape), scalar.handle.data[0])
        return core.tensor(TensorHandle(data, scalar.type), block.with_element_ty(scalar.type))

    def broadcast_unlike(self, lhs, rhs):
        left, right = lhs.type, rhs.type
        if left.is_block() == right.is_block():
            alike = not left.is_block() or left.shape is right.shape
            return (lhs, rhs) if alike else broadcast(self, lhs, rhs)
        return (lhs, splat(rhs, left)) if left.is_block() else (splat(lhs, right), rhs)

    core.block_type.__init__, core.tensor.__init__ = init_block, init_tensor
    core.block_type.with_element_ty = block_of
    semantic.broadcast_impl_value = broadcast_unlike
