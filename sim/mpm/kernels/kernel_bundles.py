# SPDX-License-Identifier: MIT
"""Kernels that take bundles of arrays, and compiled graphs of such kernels.

A bundle is a NamedTuple whose fields are annotated with Taichi array or scalar types. Taichi (1.7) passes arrays to
kernels one by one, so ``kernel`` spreads the fields of a bundle over the kernel's signature and rebuilds the bundle
inside as ``ti.static``, which costs nothing at run time. ``func`` does the same for device functions.

    class Bodies(NamedTuple):
        position: Vectors3
        velocity: Vectors3

    @kernel
    def advance(dt: ti.f32, bodies: Bodies):
        for i in range(bodies.position.shape[0]):
            bodies.position[i] += dt * bodies.velocity[i]

    advance(0.1, Bodies(position=..., velocity=...))
"""

from __future__ import annotations

import functools
import inspect
import linecache
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import taichi as ti


def is_bundle(annotation: Any) -> bool:
    """Whether ``annotation`` is the class of a bundle."""
    return isinstance(annotation, type) and hasattr(annotation, "_fields")


def func(function: Callable[..., Any]) -> Any:
    """``function`` as a ``ti.func``; parameters annotated with a bundle take one."""
    for name, annotation in list(function.__annotations__.items()):
        if is_bundle(annotation):
            function.__annotations__[name] = ti.template()
    return ti.func(function)


def kernel(function: Callable[..., Any]) -> BundledKernel:
    """``function`` as a ``ti.kernel``; parameters annotated with a bundle take one."""
    return BundledKernel(function)


class BundledKernel:
    """A kernel whose arguments are arrays, scalars or bundles of them.

    arguments: type of each argument of the flat kernel by its name, ``bundle_field`` where it comes from a bundle.
    flat: the Taichi kernel that takes them one by one.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        signature = inspect.signature(function)
        scope: dict[str, Any] = {"ti": ti}
        self.arguments: dict[str, Any] = {}
        rebuilt = []
        for name, parameter in signature.parameters.items():
            if is_bundle(parameter.annotation):
                bundle = parameter.annotation
                scope[bundle.__name__] = bundle
                fields = {f"{name}_{field}": bundle.__annotations__[field] for field in bundle._fields}
                self.arguments |= fields
                rebuilt.append(f"ti.static({bundle.__name__}({', '.join(fields)}))")
            else:
                self.arguments[name] = parameter.annotation
                rebuilt.append(name)
        returned = signature.return_annotation
        function.__annotations__.pop("return", None)
        scope["body"] = func(function)
        scope |= {f"T{i}": annotation for i, annotation in enumerate(self.arguments.values())}
        parameters = ", ".join(f"{name}: T{i}" for i, name in enumerate(self.arguments))
        result, arrow = "", ""
        if returned is not inspect.Signature.empty:
            scope["Returned"], result, arrow = returned, "return ", " -> Returned"
        source = f"def {function.__name__}({parameters}){arrow}:\n    {result}body({', '.join(rebuilt)})\n"
        # Taichi reads the source of a kernel: linecache holds that of the flat one.
        file = f"<kernel {function.__module__}.{function.__name__} {id(function)}>"
        linecache.cache[file] = (len(source), None, source.splitlines(True), file)
        exec(compile(source, file, "exec", dont_inherit=True), scope)  # noqa: S102 (the text is made above)
        self.flat = ti.kernel(scope[function.__name__])

    def __call__(self, *arguments: Any) -> Any:
        """Launch the kernel."""
        return self.flat(*_flat(arguments))


def _flat(arguments: Sequence[Any]) -> Iterator[Any]:
    for argument in arguments:
        if hasattr(argument, "_fields"):
            yield from argument
        else:
            yield argument


class Launcher:
    """Compiled graph of ``kernels`` one after the other, ``repeats`` times over, in one launch.

    A kernel call costs about 9 µs of Python for each array, 0.9 ms a substep in all, as much as the work on 4000
    particles. A graph sets the arguments in C++ and holds several substeps. Parameters of the same name get the same
    argument.
    """

    def __init__(self, kernels: Sequence[BundledKernel], *, repeats: int) -> None:
        symbols: dict[str, Any] = {}
        for each in kernels:
            for name, annotation in each.arguments.items():
                if name not in symbols:
                    symbols[name] = _symbol(name, annotation)
        builder = ti.graph.GraphBuilder()
        for _ in range(repeats):
            for each in kernels:
                builder.dispatch(each.flat, *(symbols[name] for name in each.arguments))
        self._graph = builder.compile()
        self.names = tuple(symbols)

    def bind(self, arguments: Mapping[str, Any]) -> Callable[[], None]:
        """Return a launch with ``arguments``: arrays, scalars and bundles by the kernels' parameter names; others are
        ignored."""
        flat: dict[str, Any] = {}
        for name, argument in arguments.items():
            if hasattr(argument, "_fields"):
                flat |= {f"{name}_{field}": value for field, value in zip(argument._fields, argument, strict=True)}
            else:
                flat[name] = argument
        return functools.partial(self._graph.run, {name: flat[name] for name in self.names})


def _symbol(name: str, annotation: Any) -> Any:
    """The graph's argument for a kernel parameter."""
    if isinstance(annotation, ti.types.ndarray):
        return ti.graph.Arg(ti.graph.ArgKind.NDARRAY, name, dtype=annotation.dtype, ndim=1)
    return ti.graph.Arg(ti.graph.ArgKind.SCALAR, name, annotation)
