"""What is held in memory comes back as it was, in its order."""

from hypothesis import given
from hypothesis import strategies as st

from hearthlog.recorder.log.description import LogDescription
from hearthlog.recorder.log.rolling_log import HeldMessages
from hearthlog.recorder.stream import EncodedMessage

MESSAGES = st.builds(
    EncodedMessage,
    st.integers(-(1 << 63), (1 << 63) - 1),
    st.text(min_size=1, max_size=40),
    st.one_of(st.binary(max_size=400), st.integers(100_000, 300_000).map(bytes)),
)


def description(name):
    return LogDescription(name, "home", (), (), {}, ())


ITEMS = st.one_of(MESSAGES, MESSAGES, st.text(max_size=3).map(description))
DROPS = st.tuples(st.integers(0, 20), st.booleans())
STEPS = st.lists(st.one_of(st.lists(ITEMS, max_size=8), DROPS), max_size=12)


@given(STEPS)
def test_what_is_held_is_a_queue_of_messages_and_descriptions(steps):
    held, expected = HeldMessages(), []
    for step in steps:
        if isinstance(step, list):
            held.extend(step)
            expected += step
        else:
            messages, trailing = step
            messages = min(messages, sum(isinstance(item, EncodedMessage) for item in expected))
            held.drop(messages, trailing=trailing)
            while expected and (messages or (trailing and isinstance(expected[0], LogDescription))):
                messages -= isinstance(expected.pop(0), EncodedMessage)
        assert list(held) == expected
        assert bool(held) == bool(expected)
        assert (held.size == 0) == (not expected)
