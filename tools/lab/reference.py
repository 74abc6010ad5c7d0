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

The configuration is a TOML file with the keys below. All keys are optional. An environment variable
`HEARTHLOG_` plus the name of a key in capitals sets that key; lists and tables are written as JSON.
Command-line options take precedence over environment variables, these over the file, and the file
over the defaults.

`hearthlog config` prints the values in force and the origin of each: a line of the file, a
variable, or the default. It omits passwords in addresses. `hearthlog config check` starts nothing
and prints one line for each problem, with the remedy. Its exit status is

- 2 if a value is invalid;
- 1 if a model, a folder, a file or a package cannot be used;
- 3 if everybody on this machine may read a file with secrets, a file is missing that may be a
  credential of the service, an [alert](alerts.md) can never trigger, nobody reads a `text_file`, or
  something is deprecated.

`hearthlog config schema > home.schema.json` writes a JSON schema. Editors use it to check and
complete the file if its first line is `#:schema ./home.schema.json`.

On SIGHUP the recorder reads the file again. If the configuration has changed, the recorder
completes its log and restarts, with a recorded gap of a second or two. If the file is invalid, the
recorder prints the error to standard error and continues unchanged.
"""


_BRIDGE = """
## The bridge

The tables of [the bridge](bridge.md) may be in the same file: the recorder ignores them,
and writes none of them into a log. Each table is an output; without one nothing is sent.
`state`, in the table `[bridge]` itself, is the folder of the persistent state of the bridge: by
default that of systemd, or `bridge` next to the logs. The tables `[[bridge.alert]]` are
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
            "Each table `[[microphone]]` is a microphone. The default is one microphone, `mic`.",
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
