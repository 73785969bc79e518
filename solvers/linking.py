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

LINKED = "linked"
"""Mark that distinguishes the reduced form of `Linked` from that of Numba's libraries."""

_LIBRARY: Any = JITCodeLibrary
_COMPILER: Any = Compiler
"""Untyped, because the declared signatures differ from those of their subclasses."""


class Linked(_LIBRARY):
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
        return self.name, LINKED, self._get_module_for_linking().as_bitcode()

    @property
    def codegen(self) -> _Nowhere:
        """A null object for environments of functions; the libraries that link this code set their own."""
        return _Nowhere()


class _Nowhere:
    def set_env(self, name: str, env: Any) -> None:
        """Do nothing."""


class LinkedCompiler(_COMPILER):
    """Numba's compiler for kernels that are only linked."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function into a `Linked`."""
        self.state.library = Linked(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def rebuilt(context: Any, told: Any) -> CompileResult:
    """Rebuild a compile result from the output of its `_reduce`."""
    (name, kind, content), fndesc, env, signature, objectmode, lifted, annotation, reload_init, envs = told
    if kind != LINKED:
        return CompileResult._rebuild(context, *told)
    for function in reload_init:
        function()
    library = Linked(context.codegen(), name)
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
