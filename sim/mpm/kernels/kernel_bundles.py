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

import copy
import functools
import inspect
import itertools
import linecache
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import taichi as ti

from . import runtime


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


class Part(NamedTuple):
    """A function of bundles, arrays and scalars that a kernel calls."""

    body: Any
    """As a ``ti.func``."""

    parameters: Mapping[str, Any]
    """Type of each parameter by its name."""


class BundledKernel:
    """A kernel whose arguments are arrays, scalars or bundles of them.

    arguments: type of each argument of the flat kernel by its name, ``bundle_field`` where it comes from a bundle.
    flat: the Taichi kernel that takes them one by one.
    parts: the functions that it calls one after the other; parameters of the same name get the same argument.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        signature = inspect.signature(function)
        returned = signature.return_annotation
        function.__annotations__.pop("return", None)
        parameters = {name: parameter.annotation for name, parameter in signature.parameters.items()}
        self._name = f"{function.__module__}.{function.__name__}"
        self.parts: tuple[Part, ...] = (Part(func(function), parameters),)
        self.arguments = _flat_arguments(self.parts)
        self.flat = self._compose(returned, self.arguments)
        self._launcher: tuple[int, Launcher] | None = None

    def _compose(self, returned: Any, arguments: Mapping[str, Any], used: dict[str, set[str]] | None = None) -> Any:
        """The flat kernel of ``arguments``; bundles hold None for others. The names of the fields that its parts read
        are added to ``used``, by the name of their bundle, once Taichi has read it."""
        scope: dict[str, Any] = {"ti": ti} | {f"T{i}": annotation for i, annotation in enumerate(arguments.values())}
        calls = []
        for i, part in enumerate(self.parts):
            scope[f"body{i}"] = part.body
            rebuilt = []
            for name, annotation in part.parameters.items():
                if is_bundle(annotation):
                    scope[f"Bundle_{name}"] = (
                        _watched(annotation, used.setdefault(name, set())) if used is not None else annotation
                    )
                    fields = (f"{name}_{field}" for field in annotation._fields)
                    taken = (field if field in arguments else "None" for field in fields)
                    rebuilt.append(f"ti.static(Bundle_{name}({', '.join(taken)}))")
                else:
                    rebuilt.append(name)
            calls.append(f"body{i}({', '.join(rebuilt)})")
        parameters = ", ".join(f"{name}: T{i}" for i, name in enumerate(arguments))
        arrow = ""
        if returned is not inspect.Signature.empty:
            scope["Returned"], arrow = returned, " -> Returned"
            calls[-1] = f"return {calls[-1]}"
        short = self._name.rsplit(".", 1)[-1]
        source = f"def {short}({parameters}){arrow}:\n" + "".join(f"    {call}\n" for call in calls)
        # Taichi reads the source of a kernel: linecache holds that of the flat one.
        file = f"<kernel {self._name} {next(_NUMBERS)}>"
        linecache.cache[file] = (len(source), None, source.splitlines(True), file)
        exec(compile(source, file, "exec", dont_inherit=True), scope)  # noqa: S102 (the text is made above)
        return ti.kernel(scope[short])

    def lean(self) -> BundledKernel:
        """The same kernel without the arguments that it does not read.

        Taichi spends 2.6 µs on each array of each launch. Which it reads is known after it has been read once, for what
        ``ti.static`` leaves out.
        """
        used: dict[str, set[str]] = {}
        watched = self._compose(inspect.Signature.empty, self.arguments, used)
        ti.graph.GraphBuilder().dispatch(watched, *(_symbol(name, kind) for name, kind in self.arguments.items()))
        wanted = {f"{bundle}_{field}" for bundle, fields in used.items() for field in fields}
        plain = {name for part in self.parts for name in part.parameters}
        result = copy.copy(self)
        result.arguments = {n: kind for n, kind in self.arguments.items() if n in wanted or n in plain}
        result.flat = result._compose(inspect.Signature.empty, result.arguments)
        return result

    def __call__(self, *arguments: Any) -> Any:
        """Launch the kernel."""
        return self.flat(*_flat(arguments))

    def launch(self, *arguments: Any) -> None:
        """The same for a kernel that returns nothing, as a graph of one: ten times as fast to launch."""
        made = runtime.generation()
        if self._launcher is None or self._launcher[0] != made:
            self._launcher = (made, Launcher([self], repeats=1))
        self._launcher[1].run(dict(zip(self.arguments, _flat(arguments), strict=True)))


_NUMBERS = itertools.count()


def merged(kernels: Sequence[BundledKernel]) -> BundledKernel:
    """One kernel that does what ``kernels``, which return nothing, do one after the other."""
    result = copy.copy(kernels[-1])
    result.parts = tuple(part for each in kernels for part in each.parts)
    result.arguments = _flat_arguments(result.parts)
    result.flat = result._compose(inspect.Signature.empty, result.arguments)
    return result


def _flat_arguments(parts: Sequence[Part]) -> dict[str, Any]:
    """Type of each argument of the flat kernel of ``parts`` by its name."""
    arguments: dict[str, Any] = {}
    for part in parts:
        for name, annotation in part.parameters.items():
            if is_bundle(annotation):
                arguments |= {f"{name}_{field}": annotation.__annotations__[field] for field in annotation._fields}
            else:
                arguments[name] = annotation
    return arguments


def _watched(bundle: type, used: set[str]) -> type:
    """The class ``bundle`` whose instances add the names of the fields that are read to ``used``."""
    fields = bundle._fields  # type: ignore[attr-defined]

    def read(self: Any, name: str) -> Any:
        if name in fields:
            used.add(name)
        return object.__getattribute__(self, name)

    return type(bundle.__name__, (bundle,), {"__getattribute__": read, "__slots__": ()})


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

    def run(self, arguments: Mapping[str, Any]) -> None:
        """Launch with ``arguments``, arrays and scalars by their names."""
        self._graph.run(arguments)

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
