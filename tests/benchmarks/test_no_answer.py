"""What an engine that broke leaves behind is no answer of a model's."""

import pytest
from proofs import retention

from dualbrain.planner.chat import Answer
from dualbrain.planner.protocol import CRASHED, TIMEOUT


@pytest.mark.parametrize("fault", [TIMEOUT, CRASHED])
def test_an_accident_ends_the_unit(fault):
    with pytest.raises(retention.NoAnswer, match=fault):
        retention.text_of(Answer("", fault, "gone"))
