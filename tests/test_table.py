"""Tables of the command: whole where they are piped, as wide as the terminal on one."""

import os
import pty
import subprocess
import sys

import pytest

from hearthlog.tools.cli.terminal import print_confusion, print_table

HEAD = ("class", "support", "false alarms/day")
ROWS = [("objects_activity", "123", "5019.8"), ("a\x1b[31m\nb", "7", "-")]
CODE = f"from hearthlog.tools.cli.terminal import print_table; print_table({HEAD!r}, {ROWS!r})"


def printed_on_a_terminal(columns):
    shown, terminal = pty.openpty()
    env = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"COLUMNS": str(columns)}
    with subprocess.Popen([sys.executable, "-c", CODE], stdout=terminal, env=env) as process:
        os.close(terminal)
        text = b""
        while part := _read(shown):
            text += part
        assert process.wait() == 0
    os.close(shown)
    return text.decode()


def _read(terminal):
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other side is closed
        return b""


def test_a_table_is_plain_text_where_it_is_piped(capsys):
    print_table(HEAD, ROWS)
    assert capsys.readouterr().out == (
        "class             support  false alarms/day\n"
        "objects_activity      123            5019.8\n"
        "a [31m b                7                 -\n"
    )


def test_a_table_without_heads_or_rows_is_what_it_has(capsys):
    print_table((), [("3", "too short"), ("12", "silent")], words=2)
    assert capsys.readouterr().out == "3   too short\n12  silent\n"
    print_table(HEAD, [])
    assert capsys.readouterr().out == ""


def test_names_are_no_markup(capsys):
    print_table((), [("[bold]x[/bold] :smile:",)])
    assert capsys.readouterr().out == "[bold]x[/bold] :smile:\n"


@pytest.mark.parametrize("columns", [30, 80])
def test_a_table_is_no_wider_than_the_terminal_and_figures_stay_whole(columns):
    text = printed_on_a_terminal(columns)
    lines = text.replace("\x1b[1m", "").replace("\x1b[0m", "").splitlines()
    assert max(map(len, lines)) <= columns
    assert "5019.8" in text
    assert "\x1b[31m" not in text


def test_a_confusion_matrix_that_is_too_wide_is_not_drawn(capsys):
    print_confusion(["one", "two"], [["10", "2"], ["3", "400"]], "confusion")
    assert capsys.readouterr().out == "confusion\none  10    2\ntwo   3  400\n"
    names = [f"class_{place}" for place in range(40)]
    print_confusion(names, [["12345"] * 40] * 40, "confusion")
    assert capsys.readouterr().out.startswith("confusion: too many classes")
