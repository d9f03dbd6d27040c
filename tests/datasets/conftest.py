"""What the tests of data sets share."""

import pytest
from helpers.remembered_tasks import remembered_answer


@pytest.fixture(autouse=True)
def answers_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `verify` compute the same answer once in a process."""
    monkeypatch.setattr("phibench.datasets.verify.answer_spot", remembered_answer)
