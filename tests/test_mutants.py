"""Faults of `make mutants`: each still has its place in the library, and the tests that must see it exist."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FAULTS = tomllib.loads((ROOT / "tests" / "mutants" / "faults.toml").read_text(encoding="utf-8"))["fault"]


def test_every_fault_has_its_place_and_its_tests() -> None:
    assert len(FAULTS) >= 40
    lost = []
    for fault in FAULTS:
        if (ROOT / fault["file"]).read_text(encoding="utf-8").count(fault["find"]) != 1:
            lost.append(f"{fault['name']}: its text does not stand exactly once in {fault['file']}")
        for test in fault["tests"]:
            file, _, name = test.partition("::")
            if f"def {name}" not in (ROOT / file).read_text(encoding="utf-8"):
                lost.append(f"{fault['name']}: there is no test {test}")
    assert lost == []
