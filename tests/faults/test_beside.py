"""Nobody is given the number of documents that are just being removed."""

from __future__ import annotations

import pytest

from tests.faults.beside import watch
from tests.faults.cases import Bench
from tests.faults.scenarios import scenario


@pytest.mark.exhaustive
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", ["rm", "rename", "mark", "import", "repair", "reindex", "record"])
def test_questions_beside_a_command_are_answered_right_or_refused(bench: Bench, name: str) -> None:
    tried = 0
    for anew in (False, True):
        watched = watch(bench, scenario(bench, name), anew=anew)
        tried += watched.points
        assert not watched.wrong, watched.wrong
    assert tried >= 20


def test_an_index_that_is_made_again_beside_an_open_store(bench: Bench) -> None:
    watched = watch(bench, scenario(bench, "reindex one"), anew=False)
    assert not watched.wrong, watched.wrong
