"""The web application of the view: the page, and the routes that it asks."""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

from starlette.applications import Starlette
from starlette.routing import Mount
from starlette.staticfiles import StaticFiles

from hybridlog.view.context import Context, broken_response
from hybridlog.view.guard import Guard

if TYPE_CHECKING:
    from hybridlog.store import Store

ROUTES: Final = (
    "ask",
    "export",
    "images",
    "log",
    "messages",
    "points",
    "recordings",
    "series",
    "timeline",
    "track",
)
"""The modules of `routes/`."""

_STATIC: Final = Path(__file__).parent / "static"


def make_app(store: Store, token: str, port: int, *, origins: Collection[str] = ()) -> Guard:
    """The application, behind its guard.

    Args:
        store: The store that is shown.
        token: The first part of every path.
        port: The port of the server.
        origins: Origins of other pages that may read the routes below `mcap/`; without any,
            these routes do not exist.
    """
    names = (*ROUTES, "mcap") if origins else ROUTES
    routes = [
        route for name in names for route in import_module(f"hybridlog.view.routes.{name}").routes
    ]
    routes.append(Mount("/", StaticFiles(directory=_STATIC, html=True), name="page"))
    app = Starlette(routes=routes, exception_handlers={Exception: broken_response})
    app.state.context = Context(store)
    return Guard(app, token, port, shared=("/mcap/",) if origins else (), origins=origins)
