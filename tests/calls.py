"""Calls of the product that a test notes, delays or lets fail."""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Callable
from typing import Any

import pytest

from hybridlog_storage.disk import files


class Calls:
    """Stands in front of functions until the end of a test."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._patch = patch

    def __call__(
        self, owner: Any, name: str, before: Callable[..., object] | None = None
    ) -> list[tuple[Any, ...]]:
        """The arguments of each call of a function from now on.

        Args:
            owner: Its class, module or object.
            name: Its name there.
            before: Is called first, with the same arguments; may wait or raise.
        """
        made: list[tuple[Any, ...]] = []
        real = getattr(owner, name)

        def noted(*arguments: Any, **options: Any) -> Any:
            made.append(arguments)
            if before is not None:
                before(*arguments, **options)
            return real(*arguments, **options)

        is_bound = isinstance(inspect.getattr_static(owner, name), (classmethod, staticmethod))
        self._patch.setattr(owner, name, staticmethod(noted) if is_bound else noted)
        return made

    def change(self, owner: Any, name: str, change: Callable[..., Any]) -> None:
        """Let a function return what `change` makes of its result and its arguments."""
        real = getattr(owner, name)

        def changed(*arguments: Any, **options: Any) -> Any:
            return change(real(*arguments, **options), *arguments, **options)

        self._patch.setattr(owner, name, changed)

    def fail(self, owner: Any, name: str, error: BaseException | type[BaseException]) -> None:
        """Let each call of a function fail from now on."""

        def failing(*_: object, **__: object) -> None:
            raise error

        self._patch.setattr(owner, name, failing)

    def system(self, system: files.System) -> None:
        """Have another file system from now on."""
        self._patch.setattr(files, "system", system)

    def missing(self, package: str) -> None:
        """Let a package not be installed."""

        def refuse(name: str, *_: object, **__: object) -> None:
            if name.split(".", maxsplit=1)[0] == package:
                raise ImportError(name)

        self(builtins, "__import__", refuse)
