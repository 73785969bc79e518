"""Kernels that are compiled as parts of those that call them, and not by themselves as well.

Numba optimises what an inner kernel calls and makes machine code of it, then does the same again in whatever calls
that, level by level. What only other kernels call needs neither: here it stays as it was lowered, and the kernel that
Python calls is optimised as a whole, once.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, compile_result

LINKED = "linked"
"""Tells what `Linked` makes of itself from what Numba's libraries do."""

_LIBRARY: Any = JITCodeLibrary
_COMPILER: Any = Compiler
"""Their signatures tell what their subclasses do not do."""


class Linked(_LIBRARY):
    """Code that is there for linking alone: lowered, with all that it calls, and without an address."""

    def finalize(self) -> None:
        """Take in what it calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """None."""
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """There is no object code."""
        return self.name, LINKED, self._get_module_for_linking().as_bitcode()

    @property
    def codegen(self) -> _Nowhere:
        """Who is told the environment of its functions: those who link them in tell theirs."""
        return _Nowhere()


class _Nowhere:
    def set_env(self, name: str, env: Any) -> None:
        """Nothing to set."""


class LinkedCompiler(_COMPILER):
    """Numba's, for kernels that are linked."""

    def compile_extra(self, function: Any) -> Any:
        """See Numba's."""
        self.state.library = Linked(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def rebuilt(context: Any, told: Any) -> CompileResult:
    """What was compiled, from what `_reduce` of it told."""
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
