"""The first signal asks, the second leaves, and afterwards everything is as it was."""

import signal

import pytest

from dualbrain.cli.common.signals import SIGNALS, interrupt_handler


@pytest.mark.parametrize("second", SIGNALS)
@pytest.mark.parametrize("first", SIGNALS)
def test_the_first_signal_asks_and_the_second_leaves(first, second):
    before, asked = [signal.getsignal(each) for each in SIGNALS], []
    with interrupt_handler(lambda: asked.append(first)):
        signal.raise_signal(first)
        assert asked == [first]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(second)
    assert asked == [first]
    assert [signal.getsignal(each) for each in SIGNALS] == before
