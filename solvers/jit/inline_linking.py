"""Inner kernels that are compiled into their callers only, not on their own as well.

Numba optimises an inner kernel and generates its machine code, then repeats this in each caller, level by level. A
kernel that only other kernels call needs neither. Here it stays as lowered, and the kernel that Python calls is
optimised once as a whole.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, compile_result

LINKED_KIND = "linked"
"""Mark that distinguishes the reduced form of `LinkedLibrary` from that of Numba's libraries."""

_LIBRARY_CLASS: Any = JITCodeLibrary
_COMPILER_CLASS: Any = Compiler
"""Untyped, because the declared signatures differ from those of their subclasses."""


class LinkedLibrary(_LIBRARY_CLASS):
    """Code for linking only: lowered, with everything that it calls, and without an address."""

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
        """A null object for environments of functions; the libraries that link this code set their own."""
        return _NullCodegen()


class _NullCodegen:
    def set_env(self, name: str, env: Any) -> None:
        """Do nothing."""


class LinkedCompiler(_COMPILER_CLASS):
    """Numba's compiler for kernels that are only linked."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function into a `LinkedLibrary`."""
        self.state.library = LinkedLibrary(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def rebuild_result(context: Any, reduced: Any) -> CompileResult:
    """Rebuild a compile result from the output of its `_reduce`."""
    (name, kind, content), fndesc, env, signature, objectmode, lifted, annotation, reload_init, envs = reduced
    if kind != LINKED_KIND:
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
