"""The picture at the cursor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starlette.responses import Response

from hybridlog.drawing.images import picture
from hybridlog.view.context import json_response, route
from hybridlog.view.current import current
from hybridlog_storage.errors import DefinitionError, MissingDependencyError, PayloadError

if TYPE_CHECKING:
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


def image(context: Context, asked: Asked) -> Response:
    """The picture as a file; as JSON, why there is none. Headers say when it is current."""
    found = current(context, asked)
    if found.message is None:
        answer: Response = json_response({})
    elif asked.tag == found.tag:
        answer = Response(status_code=304)
    else:
        try:
            made = picture(found.message, raw=False)
            answer = Response(made.data, media_type=made.media_type)
        except (DefinitionError, MissingDependencyError, PayloadError) as error:
            answer = json_response({"problem": str(error)})
    answer.headers.update(found.headers)
    return answer


routes = [route("/image", image)]
