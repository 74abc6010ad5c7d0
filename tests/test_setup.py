"""`hearthlog setup`: from an installation to a running recorder."""

import os
import pty
import re
import select
import socket
import subprocess
import termios
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from conftest import FRESH_HEARTHLOG, HEARTHLOG
from log_fixtures import small_disk
from systemd import PREFIX, PROGRAM
from test_service import LOGS, UNIT, USER_ID, machine, service, wait_for_labels

from hearthlog.analyzer.http import free_port
from hearthlog.tools.cli.live_display import users_of_microphones
from hearthlog.tools.service.unit import bridge_unit

__all__ = ["machine", "service"]

SECONDS = 60
DEFAULTS = ("--no-service", "--yes", "--config", "home.toml")


class Terminal:
    """A terminal on which setup runs; a test reads what is shown and types."""

    def __init__(self, process, screen):
        self._process, self._screen, self.shown = process, screen, ""

    def expect(self, text):
        """Read until a text is shown; return what came before it, and forget both."""
        deadline = time.monotonic() + SECONDS
        while text not in self.shown:
            assert time.monotonic() < deadline, f"{text!r} is not shown, but {self.shown!r}"
            if select.select([self._screen], [], [], 0.2)[0]:
                try:
                    self.shown += os.read(self._screen, 4096).decode(errors="replace")
                except OSError:  # closed
                    pytest.fail(f"{text!r} is not shown, but {self.shown!r}")
        before, _, self.shown = self.shown.partition(text)
        return before

    def type(self, text):
        os.write(self._screen, text.encode())

    def answer(self, question, text=""):
        before = self.expect(question)
        self.expect(": ")
        self.type(f"{text}\n")
        return before

    def interrupt(self):
        """Press Ctrl-C, and again where Python was between its check for it and its read."""
        while self._process.poll() is None:
            self.type("\x03")
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=5)

    def settings(self):
        return termios.tcgetattr(self._screen)

    def end(self):
        """Return the exit status, and all that was shown until then."""
        shown = self.shown
        while True:
            try:
                data = os.read(self._screen, 4096)
            except OSError:
                data = b""
            if not data:
                return self._process.wait(timeout=SECONDS), shown
            shown += data.decode(errors="replace")


@contextmanager
def dialogue(folder, env, *options):
    screen, terminal = pty.openpty()
    process = subprocess.Popen(
        ["setsid", "--ctty", *FRESH_HEARTHLOG, "setup", *options],
        cwd=folder, env=env | {"COLUMNS": "200"}, stdin=terminal, stdout=terminal, stderr=terminal,
    )  # fmt: skip
    os.close(terminal)
    try:
        yield Terminal(process, screen)
    finally:
        process.kill()
        process.wait()
        os.close(screen)


QUESTIONS = {  # all of them, and answers that lead to the next
    "Number, or several": "1",
    "Room of nullsink": "",
    "Name of the home": "",
    "Time zone of the home": "",
    "Keep sound?": "",
    "Download the network yamnet": "",
    "Serve a page": "y",
    "Publish to": "y",
    "Broker, such as": "broker.lan",
    "User at the broker": "anna",
    "Password (not shown)": "secret",
    "Send alerts": "y",
    "Address for alerts": "json://127.0.0.1:9",
    "Do this": "",
}


@pytest.fixture
def home(pulse_microphone, tmp_path):
    """A folder, and the environment of a machine with a microphone and without a network."""
    nothing = str(tmp_path / "nothing")
    pulse_microphone.env |= {"XDG_DATA_HOME": nothing, "XDG_DATA_DIRS": nothing}
    return tmp_path, pulse_microphone.env


def written(folder, name="home.toml"):
    return tomllib.loads((folder / name).read_text())


def test_a_clap_moves_the_bar_and_the_answers_are_written(home, pulse_microphone):
    folder, env = home
    with dialogue(folder, env, "--no-service", "--config", "home.toml") as seen:
        seen.expect("1  nullsink")
        seen.expect("-96 dB")
        clap = np.zeros(16_000, np.int16)
        clap[:1600] = 20_000
        pulse_microphone.play(clap)
        louder = seen.expect(" -4 dB")
        assert re.search("(█|#){20}", louder)
        seen.type("1\n")
        seen.answer("Room of", "Living Room")
        seen.answer("Name of the home", "an na")
        assert "cannot be part of a file name" in seen.answer("Name of the home", "anna")
        seen.answer("Time zone", "Europe/Berlin")
        seen.answer("Keep sound?", "y")
        seen.answer("Download the network yamnet, 4 MB", "n")
        seen.answer("page", "y")
        seen.answer("MQTT", "y")
        seen.answer("Broker", "broker.lan")
        seen.answer("User", "anna")
        seen.answer("Password", "secret")
        seen.answer("alerts", "y")
        seen.answer("Address", "nonsense://")
        seen.answer("Address", "json://127.0.0.1:9")
        assert "secret" not in seen.answer("Do this", "y")
        status, shown = seen.end()
    assert status == 0, shown
    assert "hearthlog record --config" in shown
    content = written(folder)
    assert content["microphone"] == [{"name": "living_room", "device": "nullsink"}]
    assert (content["node"], content["timezone"]) == ("anna", "Europe/Berlin")
    assert (content["keep_audio"], content["bridge"]["page"]) == ("unsure", {"port": 8380})
    password = folder / "home/mqtt-password"
    broker = {"host": "broker.lan", "user": "anna", "password_file": str(password)}
    assert content["bridge"]["mqtt"] == broker
    assert password.read_text() == "secret\n"
    assert content["bridge"]["delivery"]["urls_file"] == str(folder / "home/alert-urls")
    assert [rule["rule"] for rule in content["bridge"]["alert"]] == ["recorder_silent"]
    assert [path for path in folder.rglob("*") if path.stat().st_mode & 0o077] == []


# One of each kind: a choice with a bar, a text, a password, yes or no, and what comes after all.
@pytest.mark.parametrize(
    "last",
    ["Number, or several", "Room of nullsink", "Password (not shown)", "Send alerts", "Do this"],
)
def test_ctrl_c_at_any_question_leaves_nothing_changed(home, last):
    folder, env = home
    with dialogue(folder, env, "--no-service", "--config", "home.toml") as seen:
        before = seen.settings()
        for question, answer in QUESTIONS.items():
            seen.expect(question)
            if question == last:
                break
            seen.expect(": ")
            seen.type(f"{answer}\n")
        seen.interrupt()
        assert seen.settings() == before  # what is typed is shown again
        status, shown = seen.end()
    lines = [line for line in shown.splitlines() if line.startswith("hearthlog:")]
    assert (status, lines) == (130, ["hearthlog: nothing was changed"]), shown
    assert "Traceback" not in shown
    assert list(folder.iterdir()) == []


def test_ctrl_c_after_the_questions_leaves_nothing_changed(home):
    folder, env = home
    with socket.create_server(("127.0.0.1", 0)) as server:  # which never answers
        proxy = f"http://127.0.0.1:{server.getsockname()[1]}"
        env = env | {"HTTPS_PROXY": proxy, "https_proxy": proxy, "NO_PROXY": "", "no_proxy": ""}
        given = [word for name, values in ANSWERED.items() for word in (name, *values)]
        given[given.index("none")] = "yamnet"
        given.remove("--yes")
        with dialogue(folder, env, "--no-service", "--config", "home.toml", *given) as seen:
            seen.answer("Do this")
            server.settimeout(SECONDS)
            with server.accept()[0]:
                seen.interrupt()
            status, shown = seen.end()
    assert status == 130, shown
    line = "hearthlog: interrupted: the configuration and the service are as before"
    assert shown.splitlines()[-1] == line
    assert times(folder) == {}


@pytest.mark.parametrize(
    ("microphones", "line"),
    [
        (["nullsink=kitchen", "nullsink=hall"], "two microphones have the device 'nullsink'"),
        (["nullsink=kitchen", "pulse=kitchen"], "two microphones have the name 'kitchen'"),
    ],
)
def test_two_microphones_that_cannot_be_told_apart_are_refused_before_the_rest(
    home, microphones, line
):
    folder, env = home
    answered = {**ANSWERED, "--microphone": (microphones[0], "--microphone", microphones[1])}
    given = [word for name, values in answered.items() for word in (name, *values)]
    result = run(folder, env, "--no-service", "--config", "home.toml", *given)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == f"hearthlog: {line}: give each its own"
    assert "Configuration" not in result.stderr
    assert times(folder) == {}


def run(folder, env, *options):
    return subprocess.run(
        [*HEARTHLOG, "setup", *options], cwd=folder, env=env, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=SECONDS, check=False,
    )  # fmt: skip


def refused(folder, env, *options, status=1):
    """Run setup, which changes nothing; return its one line."""
    before = times(folder)
    result = run(folder, env, *options)
    assert result.returncode == status, result.stderr
    assert times(folder) == before
    assert result.stdout == ""
    return result.stderr.splitlines()[-1]


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


ANSWERED = {
    "--microphone": ("nullsink=kitchen",),
    "--node": ("anna",),
    "--timezone": ("Europe/Berlin",),
    "--no-keep-sound": (),
    "--network": ("none",),
    "--no-page": (),
    "--mqtt": ("none",),
    "--alerts": ("none",),
    "--yes": (),
}


@pytest.mark.parametrize("option", [each for each in ANSWERED if each != "--yes"])
def test_without_a_terminal_a_question_names_its_option(home, option):
    given = [word for name, values in ANSWERED.items() for word in (name, *values)]
    place = given.index(option)
    left = given[:place] + given[place + 1 + len(ANSWERED[option]) :]
    left.remove("--yes")
    line = refused(*home, "--no-service", *left, status=2)
    assert "there is no terminal to ask on; give" in line
    assert option in line


def test_options_answer_everything(home):
    folder, env = home
    (folder / "password").write_text("secret\n")
    (folder / "urls").write_text("json://127.0.0.1:9\n")
    result = run(
        folder, env, *DEFAULTS, "--microphone", "nullsink=kitchen", "--node", "anna",
        "--mqtt", "broker.lan", "--mqtt-user", "anna", "--mqtt-password-file", "password",
        "--alerts", "urls", "--page", "--page-port", str(free_port()),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    content = written(folder)
    assert content["microphone"] == [{"name": "kitchen", "device": "nullsink"}]
    assert (folder / "home/mqtt-password").read_text() == "secret\n"
    assert "embedding" not in content or content["embedding"] == ""


def test_an_existing_configuration_keeps_its_comments_and_other_keys(home):
    folder, env = home
    before = (
        '# of Anna\nnode = "anna"  # her name\nmin_free_space = "1G"\n\n[[microphone]]\n'
        'name = "kitchen"  # at the window\ndevice = "nullsink"\nchannel = 1\n'
    )
    (folder / "home.toml").write_text(before)
    (folder / "home.toml").chmod(0o640)
    line = refused(folder, env, *(each for each in DEFAULTS if each != "--yes"), status=2)
    assert "there is no terminal" in line
    result = run(folder, env, *DEFAULTS, "--node", "berta")
    assert result.returncode == 0, result.stderr
    assert '-node = "anna"  # her name\n+node = "berta"  # her name\n' in result.stderr
    after = (folder / "home.toml").read_text()
    assert after.startswith('# of Anna\nnode = "berta"  # her name\nmin_free_space = "1G"\n')
    assert after.endswith(before[before.index("[[microphone]]") :])
    assert (folder / "home.toml").stat().st_mode & 0o777 == 0o640
    assert run(folder, env, *DEFAULTS).returncode == 0
    assert (folder / "home.toml").read_text() == after


@pytest.mark.parametrize(
    ("options", "status", "output"),
    [
        (("--node", "an na"), 2, "--node: node name 'an na' cannot be part of a file name"),
        (("--timezone", "Mars"), 2, "--timezone: "),
        (("--microphone", "nullsink"), 2, "is not DEVICE=ROOM, such as"),
        (("--microphone", "nullsink=küche"), 2, "cannot be a topic: use lower-case letters"),
        (("--microphone", "none=kitchen"), 1, "no microphone is called 'none'; there are"),
        (("--network", "vggish"), 2, "is neither yamnet nor none"),
        (("--mqtt", "mqtt://broker"), 2, "write only the host name"),
        (("--mqtt-user", "anna"), 2, "need --mqtt HOST"),
        (("--alerts", "missing"), 1, "missing: No such file or directory"),
        (("--alerts", "wrong"), 1, "is none of Apprise's"),
        (("--page-port", "80"), 2, "--page-port needs --page"),
    ],
)
def test_a_wrong_answer_is_refused_with_one_line(home, options, status, output):
    folder, env = home
    (folder / "wrong").write_text("nonsense\n")
    assert output in refused(folder, env, *DEFAULTS, *options, status=status)


def test_an_occupied_port_is_refused_with_one_line(home):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        line = refused(*home, *DEFAULTS, "--page", "--page-port", port, status=2)
    assert f"port {port} is used by another program; choose another one" in line


def test_a_machine_without_microphones_is_refused_with_one_line(home):
    folder, env = home
    (folder / "asound.conf").write_text("pcm.none { type hw card 99 }\n")
    env = env | {"ALSA_CONFIG_PATH": str(folder / "asound.conf")}
    assert "no microphone found: connect one" in refused(folder, env, *DEFAULTS)


def test_a_microphone_that_another_program_uses_is_refused_with_one_line(labmic, tmp_path):
    labmic.add_device("other")
    labmic.occupy()
    answers = (*DEFAULTS, "--microphone", "labmic=kitchen")
    result = run(tmp_path, labmic.env, *answers)
    assert result.returncode == 1
    assert list(tmp_path.iterdir()) == []
    assert result.stderr == (
        "hearthlog: no microphone is called 'labmic'; there are 'other'; one that another program "
        "uses is not listed, end that program\n"
    )
    labmic.restore()
    assert run(tmp_path, labmic.env, *answers).returncode == 0


def test_a_missing_microphone_names_what_uses_the_cards(tmp_path):
    for card, status in (
        ("card0", "closed\n"),
        ("card1", f"state: RUNNING\nowner_pid   : {os.getpid()}\n"),
    ):
        (tmp_path / card / "pcm0c/sub0").mkdir(parents=True)
        (tmp_path / card / "pcm0c/sub0/status").write_text(status)
        (tmp_path / card / "id").write_text("Yeti\n")
    (user,) = users_of_microphones(tmp_path)
    assert user.startswith("the card Yeti is used by ")
    assert str(os.getpid()) in user


def test_a_network_that_cannot_be_fetched_leaves_nothing_changed(home):
    folder, env = home
    env = env | {"HTTPS_PROXY": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    line = refused(folder, env, *DEFAULTS, "--network", "yamnet")
    assert "or give its file" in line


@pytest.mark.parametrize("text", ["node = 'a'\nears = 2\n", "node = 'a"])
def test_a_configuration_that_this_version_cannot_read_is_left_alone(home, text):
    folder, env = home
    (folder / "home.toml").write_text(text)
    assert "home.toml" in refused(folder, env, *DEFAULTS, status=2)


def test_a_full_disk_is_refused_with_one_line(home):
    folder, env = home
    (folder / "home.toml").write_text('min_free_space = "900T"\n')
    assert "of the disk are free, and the recorder keeps" in refused(folder, env, *DEFAULTS)


@pytest.mark.parametrize("pages", range(5))
def test_a_disk_that_is_full_in_the_middle_keeps_the_configuration(home, pages):
    folder, env = home
    (folder / "password").write_text("secret\n")
    before = 'node = "anna"\n' + "# a comment\n" * 400  # two pages of memory
    with small_disk(folder / "disk", "64k") as disk:
        config = disk / "home.toml"
        config.write_text(before)
        page = os.sysconf("SC_PAGE_SIZE")
        (disk / "film").write_bytes(bytes((os.statvfs(disk).f_bavail - pages) * page))
        line = refused(
            folder, env, "--no-service", "--yes", "--config", str(config), "--node", "berta",
            "--mqtt", "broker.lan", "--mqtt-user", "anna", "--mqtt-password-file", "password",
        )  # fmt: skip
        assert "No space left on device" in line
        assert str(disk) in line
        assert config.read_text() == before
        assert sorted(path.name for path in disk.iterdir()) == ["film", "home.toml"]


def test_a_configuration_that_cannot_be_used_is_taken_back(home):
    folder, env = home
    before = 'model = "gone.safetensors"\n'
    (folder / "home.toml").write_text(before)
    result = run(folder, env, *DEFAULTS, "--node", "anna")
    assert result.returncode
    assert "gone.safetensors: no such model file" in result.stderr
    assert (folder / "home.toml").read_text() == before
    assert [path.name for path in folder.iterdir()] == ["home.toml"]


@pytest.fixture
def unset(service):
    """A machine without a user, a configuration and a service of hearthlog."""
    service.run("userdel", "hearthlog")
    service.run("rm", "-rf", "/etc/hearthlog.toml", "/etc/hearthlog")
    yield service
    service.run("systemctl", "disable", "--now", "hearthlog-bridge", check=False)
    service.run("rm", "-rf", "/etc/hearthlog.toml", "/etc/hearthlog", BRIDGE_UNIT)
    made = ("useradd", "--system", "--user-group", "--home-dir", "/var/lib/hearthlog", "hearthlog")
    service.run(*made, check=False)


def set_up(machine, *options, **how):
    return machine.run(PROGRAM, "setup", "--yes", *options, seconds=300, **how)


BRIDGE_UNIT = "/etc/systemd/system/hearthlog-bridge.service"
LIBRARY = "[Service]\nEnvironment=LD_LIBRARY_PATH=/opt/python/lib\n"  # of the bridge's Python


def test_root_sets_up_a_service_that_records(unset):
    unset.write("/root/password", "secret\n")
    unset.write(f"{BRIDGE_UNIT}.d/python.conf", LIBRARY)
    how = ("--microphone", "labmic=kitchen", "--node", "anna", "--page", "--mqtt", "127.0.0.1")
    login = ("--mqtt-user", "anna", "--mqtt-password-file", "/root/password")
    result = set_up(unset, *how, *login)
    assert f"{LOGS}: the labels of kitchen arrive\n" in result.stdout
    assert "the page: http://127.0.0.1:8380/?token=" in result.stdout
    assert f"`sudo -u hearthlog hearthlog info {LOGS}`" in result.stdout
    assert wait_for_labels(unset)
    modes = unset.run("stat", "-c", "%a %U", "/etc/hearthlog.toml", "/etc/hearthlog/mqtt-password")
    assert modes.stdout.split("\n")[:2] == ["644 root", "600 hearthlog"]
    before = unset.shows("MainPID")
    result = set_up(unset, "--no-page", "--mqtt", "none")  # while the recorder has the microphone
    assert "-[bridge.page]" in result.stderr
    assert unset.shows("MainPID") not in {before, "0"}
    assert unset.shows("ActiveState", unit="hearthlog-bridge") == "inactive"


def test_ctrl_c_while_the_service_starts_keeps_what_it_needs(unset):
    unset.write(f"{UNIT}.d/slow.conf", "[Service]\nExecStartPre=/bin/sleep 100\n")
    with ThreadPoolExecutor() as pool:
        result = pool.submit(set_up, unset, check=False)
        unset.wait(lambda: unset.shows("ActiveState") == "activating")
        unset.run("pkill", "-INT", "-f", "hearthlog setup")
        result = result.result()
    assert result.returncode == 1
    line = "hearthlog: interrupted: hearthlog.service is installed, and may not have started; "
    assert result.stderr.splitlines()[-1] == f"{line}run the command again"
    unset.run("test", "-e", "/etc/hearthlog.toml")
    unset.run("id", "hearthlog")
    unset.run("rm", "-r", f"{UNIT}.d")
    assert "the labels of mic arrive" in set_up(unset).stdout


def test_a_bridge_that_cannot_run_is_refused_before_the_recorder_is_installed(unset):
    text = '[bridge.delivery]\nurls_file = "/root/urls"\n'
    unset.write("/root/urls", "json://127.0.0.1:9\n")
    unset.write("/etc/hearthlog.toml", text)
    result = set_up(unset, check=False)
    assert result.returncode == 1
    assert "/root/urls: urls_file is in a folder that the service does not see" in result.stderr
    assert unset.run("cat", "/etc/hearthlog.toml").stdout == text
    assert unset.run("id", "hearthlog", check=False).returncode
    assert unset.run("ls", UNIT, check=False).returncode


def test_a_user_sets_up_a_service_that_records_in_the_current_folder(unset):
    unset.run("systemctl", "start", f"user@{USER_ID}")
    env = {"XDG_RUNTIME_DIR": f"/run/user/{USER_ID}", "HOME": "/home/anna"}
    how = {"user": "anna", "env": env, "seconds": 300}
    command = f"{PROGRAM} setup --yes --microphone labmic=kitchen"
    result = unset.run("sh", "-c", f"mkdir ~/hearing && cd ~/hearing && {command}", **how)
    assert "/home/anna/hearing/logs: the labels of kitchen arrive\n" in result.stdout
    assert "loginctl enable-linger" in result.stderr
    result = unset.run("sh", "-c", f"cd && {command}", check=False, **how)
    assert result.stderr.endswith(
        "records in /home/anna/hearing; run `hearthlog setup` in that folder\n"
    )
    assert unset.run("ls", "/home/anna").stdout == "hearing\n"
    unset.run("systemctl", "--user", "disable", "--now", "hearthlog", **how)
    unset.run("rm", "-r", "/home/anna/hearing", "/home/anna/.config/systemd")


def test_a_user_is_refused_a_second_recorder_on_the_machine(unset):
    unset.run("systemctl", "start", f"user@{USER_ID}")
    set_up(unset)
    env = {"XDG_RUNTIME_DIR": f"/run/user/{USER_ID}", "HOME": "/home/anna"}
    for verb in ("setup --yes", "install-service --user"):
        command = f"cd && {PROGRAM} {verb}"
        result = unset.run("sh", "-c", command, check=False, user="anna", env=env)
        assert result.returncode == 1
        assert result.stderr.splitlines()[-1] == (
            f"hearthlog: {UNIT} records on this machine: change it with `sudo hearthlog setup`, "
            "or first end it: sudo systemctl disable --now hearthlog"
        )
    assert unset.run("ls", "/home/anna").stdout == ""


def test_a_service_of_another_installation_is_left_alone(unset):
    set_up(unset)
    text = unset.run("cat", UNIT).stdout.replace(PREFIX, "/opt/other")
    unset.write(UNIT, text)
    result = set_up(unset, check=False)
    assert result.returncode == 1
    assert "/opt/other/bin/hearthlog, another installation" in result.stderr
    assert unset.run("cat", UNIT).stdout == text


def test_a_service_that_cannot_run_leaves_nothing_changed(unset):
    unset.write("/etc/hearthlog.toml", "output = '/srv/none'\n")
    result = set_up(unset, "--node", "anna", check=False)
    assert "/srv/none: no such folder; make it, and give it to hearthlog" in result.stderr
    assert unset.run("cat", "/etc/hearthlog.toml").stdout == "output = '/srv/none'\n"
    assert unset.run("id", "hearthlog", check=False).returncode
    assert unset.run("ls", UNIT, check=False).returncode


PACKAGED = "/usr/lib/systemd/system/hearthlog.service"
PACKAGED_BRIDGE = "/usr/lib/systemd/system/hearthlog-bridge.service"


def test_the_service_of_a_package_is_restarted_as_it_is(unset):
    set_up(unset)
    unset.run("systemctl", "disable", "--now", "hearthlog")
    unset.run("mv", UNIT, PACKAGED)
    unset.run("systemctl", "daemon-reload")
    result = set_up(unset, "--node", "anna")
    assert "the labels of mic arrive" in result.stdout
    assert unset.run("ls", UNIT, check=False).returncode
    line = set_up(unset, "--config", "/etc/other.toml", check=False).stderr
    assert f"{PACKAGED}: reads /etc/hearthlog.toml; give that" in line
    unset.run("systemctl", "disable", "--now", "hearthlog")
    unset.run("rm", PACKAGED)


def test_the_bridge_of_a_package_reads_the_logs_and_secrets_of_the_recorder(unset):
    text = bridge_unit([PROGRAM, "bridge", "--config", "/etc/hearthlog.toml"], None, "hearthlog",
                       LOGS, [])  # fmt: skip
    unset.write(PACKAGED_BRIDGE, text)
    unset.write(f"{BRIDGE_UNIT}.d/python.conf", LIBRARY)
    assert "the page: http://127.0.0.1:8380/?token=" in set_up(unset, "--page").stdout
    assert unset.shows("ActiveState", unit="hearthlog-bridge") == "active"
    unset.run("rm", PACKAGED_BRIDGE)
