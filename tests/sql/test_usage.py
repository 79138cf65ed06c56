"""The paths that a query may use are found, and never too few."""

from __future__ import annotations

import duckdb
import pytest

from hybridlog.sql.content import TREE, paths_named
from hybridlog.sql.views import Reading

PATH = ("echo", "far")


@pytest.fixture(scope="module")
def parser() -> duckdb.DuckDBPyConnection:
    return duckdb.connect()


def uses(parser: duckdb.DuckDBPyConnection, query: str, path: tuple[str, ...] = PATH) -> bool:
    ((tree,),) = parser.execute(TREE, [query]).fetchall()
    return Reading(paths_named(tree)).names(path)


USED = """
select * from scan
from scan
select scan.* from scan
select * exclude (t) from scan
select * replace (1 as t) from scan
select columns('e.*') from scan
select echo from scan
select echo.far from scan
select Echo.FAR[3] from scan
select echo['far'] from scan
select (echo).far from scan
select s.echo.far.x from scan s
select x.far from (select echo as x from scan)
select s from scan s
select scan from scan
select z from (select t from scan) z
with z as (select t from scan) select z from z
select struct_extract(echo, 'far') from scan
select t from scan where echo is null
select t from scan order by echo
select t from scan group by t, echo
select unnest(echo) from scan
select #3 from scan
select t from scan natural join odom
select t from scan join odom using (echo)
select x from scan as s(x, y)
select t from scan order by all
select t from a_macro()
select t from query('select * from scan')
select t from query_table('scan')
describe scan
summarize scan
pivot scan on t using sum(seq)
create table x as select t from scan
explain select t from scan
select count(s) from scan s
select t from scan where t in (select max(echo.far[1]) from odom)
select sum(t) over (order by echo) from scan
select list_transform([1], lambda x: echo.far[x]) from scan
select t from scan qualify row_number() over (order by echo.far) = 1
select t from scan s where s = s
"""


@pytest.mark.parametrize("query", USED.strip().splitlines())
def test_used(parser: duckdb.DuckDBPyConnection, query: str) -> None:
    assert uses(parser, query)


def test_paths_are_compared_by_whole_names(parser: duckdb.DuckDBPyConnection) -> None:
    query = "select a.b.c, e.f from scan"
    assert uses(parser, query, ("a", "b", "c"))
    assert uses(parser, query, ("a", "b", "c", "d"))
    assert uses(parser, query, ("b", "c"))
    assert not uses(parser, query, ("a", "c"))
    assert not uses(parser, query, ("a", "b", "d"))
    assert not uses(parser, query, ("ab", "c"))
    assert uses(parser, query, ("f",))
    assert Reading(None).names(("anything",))
