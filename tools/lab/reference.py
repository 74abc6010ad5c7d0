"""`python -m hearthlog.tools.lab.reference > docs/configuration.md`: what can be configured."""

import json
from collections.abc import Iterator
from typing import Any

from hearthlog.analyzer.bridge.settings import BridgeSettings
from hearthlog.recorder.config import Settings

_HEAD = """\
# Configuration

    hearthlog record --config home.toml
    hearthlog config --config home.toml
    hearthlog config check home.toml

A configuration is a TOML file of the keys below, all of which may be left out. `HEARTHLOG_` and
the name of a key is a variable of the environment, with lists and tables as JSON. An option of
the command line goes before the environment, that before the file, and that before the default.

`hearthlog config` prints all values in force, and where each comes from: the line of the file, a
variable, or the default. Passwords of addresses are left out. `hearthlog config check` starts
nothing, and says all that is wrong, each in a line with what to write: exit status 2 if a value
makes no sense, 1 if a model, the folder, a file or a package that is named cannot be used, 3 if
everybody on this machine may read a file with secrets, a file is not here that may be a credential
of the service, an [alert](alerts.md) cannot ring, nobody reads a `text_file`, or something is
deprecated.
`hearthlog config schema > home.schema.json` writes a JSON schema, by which editors check and
complete the file if its first line is `#:schema ./home.schema.json`.

At SIGHUP the recorder reads the file again. If the configuration has changed it completes its log
and starts again, with a gap of a second or two that says so; if it is wrong, a line on standard
error says why, and it goes on as before.
"""


_BRIDGE = """
## The bridge

The tables of [the bridge](bridge.md) may stand in the same file: the recorder ignores them,
and writes none of them into a log. Each is an output; without one nothing is sent.
`state`, in the table `[bridge]` itself, is the folder of what the bridge has to remember: by
default that of systemd, or `bridge` beside the logs. The tables `[[bridge.alert]]` are
[the rules of alerts](alerts.md#rules).
"""
_TABLES = ("mqtt", "prometheus", "page", "ping", "delivery")


def configuration_page() -> str:
    """Return the page of everything that can be configured, as Markdown."""
    schema = Settings.model_json_schema()
    microphone = schema["$defs"]["MicrophoneSettings"]
    tables = BridgeSettings.model_json_schema()["$defs"]
    return "\n".join(
        [
            _HEAD,
            *_table(schema["properties"]),
            "",
            "## A microphone",
            "",
            "Each table `[[microphone]]` is one. Without any there is the default one: `mic`.",
            "",
            *_table(microphone["properties"]),
            _BRIDGE,
            *(
                line
                for name in _TABLES
                for line in (
                    f"### bridge.{name}",
                    "",
                    *_table(tables[f"{name.capitalize()}Settings"]["properties"]),
                    "",
                )
            ),
        ]
    )


def _table(properties: dict[str, Any]) -> Iterator[str]:
    yield "| key | values | default | |"
    yield "|---|---|---|---|"
    for name, about in properties.items():
        if name != "microphone":
            default = _code(about["default"]) if "default" in about else ""
            yield f"| `{name}` | {_values(about)} | {default} | {about['description']} |"


def _values(about: dict[str, Any]) -> str:
    if "enum" in about:
        return ", ".join(map(_code, about["enum"]))
    if "anyOf" in about:
        kinds = [each for each in about["anyOf"] if each.get("type") != "null"]
        return _values(kinds[0]) if len(kinds) == 1 else "size"
    if about["type"] in {"number", "integer"}:
        return _numbers(about)
    if about["type"] == "array" and about["items"]["type"] == "array":
        return "list of lists of numbers"
    words = {
        "array": "list of texts",
        "object": "table of paths",
        "boolean": "`true`, `false`",
        "string": "text",
    }
    return "path" if about.get("format") == "path" else words[about["type"]]


def _numbers(about: dict[str, Any]) -> str:
    least, most = about.get("minimum"), about.get("maximum")
    kind = "number" if about["type"] == "number" else "whole number"
    if most is not None:
        return f"{kind}, {least:.10g} to {most:.10g}"
    return kind if least is None else f"{kind}, {least:g} or more"


def _code(value: Any) -> str:
    return "" if value is None else f"`{json.dumps(value)}`"


if __name__ == "__main__":
    print(configuration_page(), end="")
