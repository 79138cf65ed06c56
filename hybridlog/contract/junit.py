"""Results of a contract in the XML of JUnit, as CI servers read it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

if TYPE_CHECKING:
    from hybridlog.contract.judge import Result


def junit_of(results: Sequence[Result]) -> str:
    """A suite for each recording, a case for each rule."""
    root = ET.Element("testsuites")
    suites: dict[str, list[Result]] = defaultdict(list)
    for one in results:
        suites[one.recording].append(one)
    for recording, cases in suites.items():
        bad = sum(not one.holds for one in cases)
        about = {"name": recording, "tests": str(len(cases)), "failures": str(bad)}
        suite = ET.SubElement(root, "testsuite", _plain(about))
        for one in cases:
            named = {"classname": one.topic or "recording", "name": f"{one.rule}: {one.wanted}"}
            case = ET.SubElement(suite, "testcase", _plain(named))
            if not one.holds:
                ET.SubElement(case, "failure", _plain({"message": f"found {one.found}"}))
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _plain(texts: dict[str, str]) -> dict[str, str]:
    """Texts without characters that XML cannot hold."""
    return {
        name: "".join(c if c.isprintable() else "?" for c in text) for name, text in texts.items()
    }
