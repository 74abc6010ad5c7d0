"""Tables and messages of the command: whole where they are piped, as wide as a terminal on one."""

import os
import pty
import subprocess
import sys

import pytest

from hearthlog.tools.cli.tables import print_counts
from hearthlog.tools.cli.terminal import dim, print_notice, print_table, two_part_bar

HEAD = ("class", "support", "false alarms/day")
ROWS = [("objects_activity", "123", "5019.8"), ("a\x1b[31m\nb", "7", "-")]
CODE = f"from hearthlog.tools.cli.terminal import print_table; print_table({HEAD!r}, {ROWS!r})"


def printed_on_a_terminal(columns, code=CODE, stream="stdout"):
    shown, terminal = pty.openpty()
    env = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"COLUMNS": str(columns)}
    with subprocess.Popen([sys.executable, "-c", code], env=env, **{stream: terminal}) as process:
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


@pytest.mark.parametrize("count", [1, 600])
def test_a_title_among_rows_widens_no_column(count, capsys):
    rows = [("1:00", "cough"), ("2:00", "chime")]
    print_table(
        ("when", "sound"), [("A night and a day",), *rows * count, ("",), ("Noon",), rows[0]]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == ["when  sound", "A night and a day", "1:00  cough", "2:00  chime"]
    assert lines[-3:] == ["", "Noon", "1:00  cough"]
    assert len(lines) == 2 * count + 5


@pytest.mark.parametrize(
    ("shares", "bar"),
    [
        ((1.0, 0.0), ("████████", "")),
        ((0.0, 0.0), ("", "")),
        ((0.0, 1.0), ("", "░░░░░░░░")),
        ((0.001, 0.5), ("▏", "░░░")),
        ((0.5, 0.001), ("████", "░")),
        ((0.999, 0.001), ("███████", "░")),
    ],
)
def test_a_bar_of_two_parts_has_a_block_for_each_that_there_is(shares, bar):
    assert two_part_bar(*shares, 8) == bar


def test_the_second_part_of_a_bar_is_pale_on_a_terminal_with_colours_only(monkeypatch):
    code = "from hearthlog.tools.cli.terminal import dim; print(dim('x'), dim(''))"
    monkeypatch.setenv("TERM", "xterm-256color")
    assert printed_on_a_terminal(80, code) == "\x1b[2mx\x1b[0m \r\n"
    monkeypatch.setenv("TERM", "dumb")
    assert printed_on_a_terminal(80, code) == "x \r\n"
    assert dim("x") == "x"


@pytest.mark.parametrize("columns", [30, 80])
def test_a_table_is_no_wider_than_the_terminal_and_figures_stay_whole(columns):
    text = printed_on_a_terminal(columns)
    lines = text.replace("\x1b[1m", "").replace("\x1b[0m", "").splitlines()
    assert max(map(len, lines)) <= columns
    assert "5019.8" in text
    assert "\x1b[31m" not in text


WIDE = ("class", "support", "precision", "recall", "F1", "95 %", "1-s F1", "false alarms/day")
FIGURES = ("Telephone ringing", "1234", "0.5", "0.5", "0.5", "0.521-0.734", "0.5", "100.1")


@pytest.mark.parametrize("columns", range(20, 120, 7))
def test_no_word_of_a_table_is_broken(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    print_table(WIDE, [FIGURES, FIGURES])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= columns
    assert {word for cell in (*WIDE[1:], *FIGURES) for word in cell.split()} <= {
        word.strip(",") for word in text.split()
    }


def test_a_table_that_fits_no_terminal_is_a_list_with_the_heads_beside_the_figures(
    monkeypatch, capsys
):
    monkeypatch.setenv("COLUMNS", "40")
    print_table(WIDE, [FIGURES])
    assert capsys.readouterr().out == (
        "Telephone ringing\n"
        "    support 1234, precision 0.5, recall\n"
        "    0.5, F1 0.5, 95 % 0.521-0.734, 1-s\n"
        "    F1 0.5, false alarms/day 100.1\n"
    )


@pytest.mark.parametrize("columns", [30, 60])
def test_a_message_on_a_terminal_breaks_between_words_and_in_no_command(columns):
    text = "a message for people who read it; next: `hearthlog review logs --queue`, or wait"
    code = f"from hearthlog.tools.cli.terminal import print_notice; print_notice({text!r})"
    lines = printed_on_a_terminal(columns, code, "stderr").splitlines()
    assert max(map(len, lines)) <= max(columns, 40)
    assert " ".join(" ".join(lines).split()) == f"hearthlog: {text}"
    assert any("`hearthlog review logs --queue`" in line for line in lines)


def test_a_message_that_is_piped_is_one_line(capfd):
    text = "a message for people " * 20
    print_notice(text)
    assert capfd.readouterr().err == f"hearthlog: {text}\n"


def test_a_confusion_matrix_that_is_too_wide_is_not_drawn(capsys):
    print_counts(["one", "two"], [[10, 2], [3, 400]])
    title = "confusion: true class in rows, predicted in columns"
    assert capsys.readouterr().out == f"{title}\nOne  10    2\nTwo   3  400\n"
    names = [f"class_{place}" for place in range(40)]
    print_counts(names, [[12345] * 40] * 40)
    assert capsys.readouterr().out.startswith("confusion: too many classes")
