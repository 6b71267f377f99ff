"""Triton's interpreter without what it does again and again, or for nothing; kernels compute the same in it."""

import functools
from dataclasses import replace
from types import ModuleType
from typing import Any


def spare_repeated_work():
    """For the rest of this process (Triton 3.6 to 3.9). More than half of the kernels' time goes there without it."""
    from triton import language
    from triton.runtime import interpreter

    builder = interpreter.interpreter_builder
    if not builder.options.debug:  # seven operations on each sum of integers, for a condition that only debug looks at
        builder.options = replace(builder.options, sanitize_overflow=False)
    interpreter._patch_lang = PatchOnce(interpreter._patch_lang, {language, language.core})
    find, found = interpreter._get_np_dtype, {}

    def np_dtype(dtype):
        """Of a type of the language; the interpreter makes a table of all of them at each call."""
        if dtype.name not in found:
            found[dtype.name] = find(dtype)
        return found[dtype.name]

    interpreter._get_np_dtype = np_dtype
    _remember_shapes(language.core, language.semantic.TritonSemantic)


def _remember_shapes(core, semantic):
    """Of tensors and their types, which the language wraps number by number for each result; of two tensors of one
    shape none is broadcast."""
    block_init, tensor_init, broadcast = core.block_type.__init__, core.tensor.__init__, semantic.broadcast_impl_value
    blocks: dict[tuple[int, ...], tuple[Any, int, str]] = {}
    tensors: dict[tuple[int, ...], tuple[Any, Any]] = {}

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
        key = tuple(type.shape) if type.is_block() else ()
        if key in tensors:
            self.handle, self.type, self.dtype = handle, type, type.scalar
            self.shape, self.numel = tensors[key]
        else:
            tensor_init(self, handle, type)
            tensors[key] = self.shape, self.numel

    def broadcast_unlike(self, lhs, rhs):
        if lhs.type.is_block() and rhs.type.is_block() and lhs.type.shape is rhs.type.shape:
            return lhs, rhs
        return broadcast(self, lhs, rhs)

    core.block_type.__init__, core.tensor.__init__ = init_block, init_tensor
    semantic.broadcast_impl_value = broadcast_unlike


class PatchOnce:
    """Puts the interpreter's functions into the language once a launch, not at each call of a function in it."""

    def __init__(self, patch, languages):
        self._patch, self._languages = patch, languages
        self._patched: set[ModuleType] = set()  # in the launch under way
        self._seen = functools.cache(self._seen_by)

    def _seen_by(self, function):
        values = function.__globals__.values()
        return frozenset(value for value in values if isinstance(value, ModuleType) and value in self._languages)

    def __call__(self, function):
        """The scope that ends with the launch; of functions called in it nobody looks at theirs."""
        seen = self._seen(function)
        if seen and seen <= self._patched:
            return None
        scope = self._patch(function)
        self._patched |= seen
        return _Scope(scope, self._patched)


class _Scope:
    def __init__(self, scope, patched):
        self._scope, self._patched = scope, patched

    def restore(self):
        self._patched.clear()
        self._scope.restore()
