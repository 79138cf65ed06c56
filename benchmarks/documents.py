"""Results in the documents: a section that a benchmark writes anew."""

from __future__ import annotations

import re
from pathlib import Path


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace the part of a document between `<!-- NAME -->` and `<!-- /NAME -->`.

    Raises:
        ValueError: The document has no such part.
    """
    section = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    old = path.read_text(encoding="utf-8")
    new, count = section.subn(lambda part: f"{part[1]}{text}\n{part[2]}", old)
    if count != 1:
        raise ValueError(f"{path} must have one section <!-- {name} --> … <!-- /{name} -->")
    path.write_text(new, encoding="utf-8")
