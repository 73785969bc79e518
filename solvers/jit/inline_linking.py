"""Functions that are compiled into their callers only, not on their own as well.

Numba optimises a called function and generates its machine code, then repeats this in each caller, level by level. A
function that only kernels call needs neither: an inner kernel, and what Numba implements in Python, such as `np.empty`.
Here it remains lowered LLVM code, and the kernel that Python calls is optimised once as a whole.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from llvmlite import binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, compile_result

LINKED_KIND, KERNEL_KIND = "linked", "kernel"
"""Marks that distinguish the reduced forms of `LinkedLibrary` and `KernelLibrary` from that of Numba's libraries."""

_C_WRAPPER_NAME = "cfunc_wrapper"
"""Name of the module in which Numba wraps a function for calls from C."""

_LIBRARY_CLASS: Any = JITCodeLibrary
_COMPILER_CLASS: Any = Compiler
"""Untyped, because the declared signatures differ from those of their subclasses."""


class LinkedLibrary(_LIBRARY_CLASS):
    """Code for linking only: lowered, with everything that it calls, and without an address."""

    def add_ir_module(self, ir_module: Any) -> None:
        """Add a module of code, unless it is the wrapper for calls from C.

        Such a wrapper requires an address.
        """
        if ir_module.name != _C_WRAPPER_NAME:
            super().add_ir_module(ir_module)

    def finalize(self) -> None:
        """Link the modules of the called functions into this one."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, because the code has no address."""
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return the code as bitcode, because there is no object code."""
        return self.name, LINKED_KIND, self._get_module_for_linking().as_bitcode()

    @property
    def codegen(self) -> _NullCodegen:
        """Object that ignores environments of functions; the libraries that link this code set their own."""
        return _NullCodegen()


class KernelLibrary(_LIBRARY_CLASS):
    """Code that only Python calls.

    It is stored as machine code, without the bitcode for linking it into other code.
    """

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, list[str]]]:
        """Return the machine code, and the names that it defines."""
        parts = (*self._final_module.functions, *self._final_module.global_variables)
        names = [part.name for part in parts if not part.is_declaration]
        return self.name, KERNEL_KIND, (self._get_compiled_object(), names)

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, tuple[bytes, list[str]]]) -> KernelLibrary:
        """Return the library of stored machine code."""
        name, _, (object_code, names) = state
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(object_code)
        library._finalize_final_module()
        codegen._engine._defined_symbols |= {*names}
        return library


class _NullCodegen:
    def set_env(self, name: str, env: Any) -> None:
        """Do nothing."""


@contextmanager
def _use_library_class(codegen: Any, library_class: type) -> Generator[None]:
    """Create libraries of a class inside the block.

    Numba compiles under a global lock, in one thread at a time.
    """
    before = codegen._library_class
    codegen._library_class = library_class
    try:
        yield
    finally:
        codegen._library_class = before


class KernelCompiler(_COMPILER_CLASS):
    """Numba's compiler for kernels that Python calls: what they call is only linked."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function, and all that it calls into `LinkedLibrary`."""
        codegen = self.state.targetctx.codegen()
        self.state.library = KernelLibrary(codegen, function.__qualname__)
        self.state.library.enable_object_caching()
        with _use_library_class(codegen, LinkedLibrary):
            return super().compile_extra(function)


class ParallelCompiler(_COMPILER_CLASS):
    """Numba's compiler for kernels with parallel loops, whose parts are called by address."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function, and all that it calls, to machine code."""
        with _use_library_class(self.state.targetctx.codegen(), _LIBRARY_CLASS):
            return super().compile_extra(function)


class LinkedCompiler(_COMPILER_CLASS):
    """Numba's compiler for kernels that are only linked."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function into a `LinkedLibrary`."""
        self.state.library = LinkedLibrary(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def rebuild_result(context: Any, reduced: Any) -> CompileResult:
    """Rebuild a compile result from its reduced form.

    Args:
        context: target context of the process that loads the code.
        reduced: output of the result's `_reduce`, of one of the libraries above or of Numba's.
    """
    (name, kind, content), fndesc, env, signature, objectmode, lifted, annotation, reload_init, envs = reduced
    if kind != LINKED_KIND:
        library_class = KernelLibrary if kind == KERNEL_KIND else _LIBRARY_CLASS
        with _use_library_class(context.codegen(), library_class):
            return CompileResult._rebuild(context, *reduced)
    for function in reload_init:
        function()
    library = LinkedLibrary(context.codegen(), name)
    library._final_module = binding.parse_bitcode(content)
    library._finalized = True
    return compile_result(
        target_context=context,
        typing_context=context.typing_context,
        library=library,
        environment=env,
        entry_point=context.get_executable(library, fndesc, env),
        fndesc=fndesc,
        type_annotation=annotation,
        signature=signature,
        objectmode=objectmode,
        lifted=lifted,
        reload_init=reload_init,
        referenced_envs=envs,
    )
