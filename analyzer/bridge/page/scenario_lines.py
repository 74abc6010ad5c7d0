"""What the models of scenarios hear now, and heard today, in words."""

from typing import Any

from hearthlog.analyzer.bridge.home_state import MicrophoneState
from hearthlog.analyzer.bridge.listeners import microphone_of_listener, scenario_of_listener
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.now_heard import heard_classes
from hearthlog.analyzer.bridge.page.words import class_words, length, room, times
from hearthlog.schemas.errors import listed


def scenario_lines(news: News) -> list[Any]:
    """Describe each scenario of each microphone for JSON, in a line."""
    state, midnight = news.state, news.today.midnight
    lines = []
    for name in sorted(state.scenarios):
        own = state.scenarios[name]
        today = _today(own, midnight)
        if own.is_listening() or today:
            where = [room(microphone_of_listener(name))] if len(state.microphones) > 1 else []
            what = " · ".join([room(scenario_of_listener(name)), *where])
            lines.append({"what": what, "about": f"Now {_now(own)}. Today {today or 'nothing'}."})
    return lines


def _now(own: MicrophoneState) -> str:
    if not own.is_listening():
        return "not listening"
    return listed([class_words(label).lower() for label in heard_classes(own)], "and") or "nothing"


def _today(own: MicrophoneState, midnight: int) -> str:
    """Say how often, and for how long, each class was heard; of the longest first."""
    events = {label: own.events(label, midnight) for label in own.labels()}
    seconds = {label: sum(each.seconds for each in same) for label, same in events.items() if same}
    return ", ".join(
        f"{class_words(label).lower()} {times(len(events[label]))} ({length(seconds[label])})"
        for label in sorted(seconds, key=lambda label: -seconds[label])
    )
