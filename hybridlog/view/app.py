"""The web application of the view: the page, and the routes that it asks."""

from __future__ import annotations

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
    from hybridlog.view.loopback import Admission

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


def make_app(store: Store, rules: Admission) -> Guard:
    """The application, behind its guard.

    Args:
        store: The store that is shown.
        rules: Who may ask. Their guests may read the routes below `mcap/`; without any, these
            routes do not exist.
    """
    has_guests = rules.viewers or bool(rules.origins)
    names = (*ROUTES, "mcap") if has_guests else ROUTES
    routes = [
        route for name in names for route in import_module(f"hybridlog.view.routes.{name}").routes
    ]
    routes.append(Mount("/", StaticFiles(directory=_STATIC, html=True), name="page"))
    app = Starlette(routes=routes, exception_handlers={Exception: broken_response})
    app.state.context = Context(store)
    return Guard(app, rules, shared=("/mcap/",) if has_guests else ())
