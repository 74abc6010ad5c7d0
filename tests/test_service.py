"""`hearthlog install-service`: a real recorder, in its sandbox, under a real systemd."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from logs import features, read
from systemd import PREFIX, PROGRAM, booted

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.tools.service.unit import STATE, Needs, bridge_unit, system_unit, user_unit

UNIT = "/etc/systemd/system/hearthlog.service"
USER_ID = "4321"
LOGS = STATE / "logs"
RECORD = ["/opt/hearthlog/bin/hearthlog", "record", "--config", "/etc/my 100% home.toml"]


def analyzed(verb, unit, folder, *options, name="hearthlog.service"):
    """What systemd-analyze says of a unit."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("what a sandbox is worth is known to the Debian package systemd")
    # Programs and users that are on this machine; systemd-analyze looks for them.
    text = unit.replace(RECORD[0], "/bin/true").replace("User=hearthlog", "User=daemon")
    (folder / name).write_text(text)
    command = ["systemd-analyze", verb, *options, str(folder / name)]
    env = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    return subprocess.run(command, capture_output=True, text=True, env=env, check=False)


@pytest.mark.parametrize("has_network", [False, True])
def test_systemd_understands_every_line_of_the_units(tmp_path, has_network):
    needs = Needs("/srv/a home", [], has_network, "group")
    system = system_unit(RECORD, "hearthlog", needs)
    user = user_unit(RECORD, Path("/home/anna/100 % home"), needs)
    for unit, options in ((system, []), (user, ["--user"])):
        result = analyzed("verify", unit, tmp_path, *options)
        assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("name", ["ho$ME", "${HOME}", "a b%c$$", "plain"])
def test_a_program_may_be_in_a_folder_with_any_name(tmp_path, name):
    program = tmp_path / name / "hearthlog"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    needs = Needs(str(LOGS), [], False, "owner")
    result = analyzed("verify", system_unit([str(program), "a$b"], "hearthlog", needs), tmp_path)
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize(("has_network", "most"), [(False, 10), (True, 16)])
def test_the_service_of_the_machine_may_do_little(tmp_path, has_network, most):
    unit = system_unit(RECORD, "hearthlog", Needs(str(LOGS), [], has_network, "owner"))
    options = ("--offline=yes", f"--threshold={most}")
    result = analyzed("security", unit, tmp_path, *options)
    assert result.returncode == 0, result.stdout
    result = analyzed("security", unit, tmp_path, "--offline=yes", "--json=short")
    denied = {each["name"] for each in json.loads(result.stdout) if each["set"]}
    assert ("PrivateNetwork=" in denied) is not has_network
    assert "MemoryDenyWriteExecute=" not in denied  # PortAudio cannot do without


@pytest.mark.parametrize("account", [None, "hearthlog"])
def test_the_service_of_the_bridge_may_do_little_but_use_the_network(tmp_path, account):
    unit = bridge_unit(RECORD, account, "hearthlog", Path("/srv/a home"), [Path("/srv/figures")])
    name = "hearthlog-bridge.service"
    result = analyzed("verify", unit, tmp_path, name=name)
    assert (result.returncode, result.stderr) == (0, "")
    options = ("--offline=yes", "--threshold=15")
    result = analyzed("security", unit, tmp_path, *options, name=name)
    assert result.returncode == 0, result.stdout


@pytest.fixture(scope="module")
def machine(labmic_plugin, tmp_path_factory):
    """A machine with a microphone and a user `hearthlog`."""
    folder = tmp_path_factory.mktemp("machine")
    shutil.copy(labmic_plugin, folder / "labmic.so")
    with booted(folder) as machine:
        machine.run("cp", folder / "labmic.so", "/opt/labmic.so")
        fields = 'type labmic rate 16000 ppm 0 ctl "/etc/labmic.control"'
        types = 'pcm_type.labmic { lib "/opt/labmic.so" }'
        machine.write("/etc/asound.conf", f"{types}\npcm.labmic {{ {fields} }}\n")
        machine.run("useradd", "--system", "--user-group", "--home-dir", STATE, "hearthlog")
        machine.run("useradd", "--create-home", "--uid", USER_ID, "anna")
        yield machine


@pytest.fixture
def service(machine):
    """The machine, on which there is no service and no log before and after the test."""
    yield machine
    machine.run("systemctl", "stop", "hearthlog", check=False)
    machine.run("rm", "-rf", UNIT, f"{UNIT}.d", STATE, "/srv/logs", "/etc/labmic.control")
    machine.run("systemctl", "daemon-reload")


def install(machine, *options, **how):
    return machine.run(PROGRAM, "install-service", *options, **how)


def logs_of(machine, folder=LOGS):
    """A copy of the logs, and a log that is being written among them."""
    shutil.rmtree(machine.folder / "logs", ignore_errors=True)
    machine.run("cp", "-r", folder, machine.folder / "logs", check=False)
    return machine.folder / "logs"


def wait_for_labels(machine, folder=LOGS, more_than=0):
    def labels():
        logs = logs_of(machine, folder)
        found = read(logs, "label") if list(logs.rglob("*.mcap*")) else []
        return found if len(found) > more_than else None

    return machine.wait(labels)


def errors(logs):
    return [line for one in examine(logs) for line in one.shown if line.level == "error"]


def test_the_service_records_in_its_sandbox(service):
    result = install(service)
    assert result.stdout == f"{UNIT}\n"
    assert service.shows("ActiveState") == "active"
    wait_for_labels(service)
    assert service.shows("StatusText") == "mic: listening"
    assert service.run("systemctl", "is-enabled", "hearthlog").stdout == "enabled\n"
    process = service.shows("MainPID")
    about = dict(
        line.split(":", 1)
        for line in service.run("cat", f"/proc/{process}/status").stdout.splitlines()
    )
    assert int(about["CapBnd"], 16) == 0
    assert (about["NoNewPrivs"].strip(), about["Seccomp"].strip()) == ("1", "2")
    links = service.run("cat", f"/proc/{process}/net/dev").stdout.splitlines()[2:]
    assert [line.split(":")[0].strip() for line in links] == ["lo"]
    spaces = [service.run("readlink", f"/proc/{pid}/ns/net").stdout for pid in (1, process)]
    assert spaces[0] != spaces[1]
    owners = service.run("find", STATE, "-printf", "%u\\n").stdout.split()
    assert set(owners) == {"hearthlog"}


def clock_of(logs):
    """What the newest report says of the clock."""
    statuses = [status for message in read(logs, "diagnostics") for status in message.status]
    values = [value for status in statuses for value in status.values]
    return [value.value for value in values if value.key == "clock_synchronized"][-1:]


def test_the_service_knows_of_the_clock_although_it_may_not_ask_for_it(service):
    service.run("mkdir", "-p", "/run/systemd/timesync")
    install(service)
    service.wait(lambda: clock_of(logs_of(service)) == ["no"])
    service.run("touch", "/run/systemd/timesync/synchronized")
    service.wait(lambda: clock_of(logs_of(service)) == ["yes"])


def test_an_upgrade_completes_the_log_and_the_next_one_states_the_gap(service):
    install(service)
    wait_for_labels(service)
    first = service.shows("MainPID")
    install(service)
    assert service.shows("MainPID") not in {first, "0"}
    wait_for_labels(service, more_than=len(read(logs_of(service), "label")))
    logs = logs_of(service)
    assert sorted(path.suffix for path in logs.rglob("*.mcap*")) == [".active", ".mcap"]
    gap = read(logs, "gap")[-1]
    assert gap.reason == "the recorder was not running"
    frames = features(logs)[0]
    assert 0 < gap.frames_lost < 30 * 20
    assert len(frames) > 40
    service.run("systemctl", "stop", "hearthlog")
    assert service.shows("Result") == "success"
    assert not errors(logs_of(service))


def test_a_recorder_that_is_killed_or_hangs_is_started_again(service):
    service.write(
        f"{UNIT}.d/quick.conf", "[Service]\nWatchdogSec=4\nTimeoutAbortSec=1\nRestartSec=1\n"
    )
    install(service)
    wait_for_labels(service)
    for signal in ("KILL", "STOP"):
        before = service.shows("MainPID"), len(read(logs_of(service), "label"))
        service.run("kill", "-s", signal, before[0])
        service.wait(lambda before=before: service.shows("MainPID") not in {before[0], "0"})
        wait_for_labels(service, more_than=before[1])
    journal = service.run("journalctl", "-u", "hearthlog", "-o", "cat").stdout
    assert "Watchdog timeout (limit 4s)!" in journal
    assert len(read(logs_of(service), "gap")) == 2


def test_a_service_without_a_microphone_is_alive_and_says_so(service):
    service.write("/etc/labmic.control", "unplug")
    service.write(f"{UNIT}.d/quick.conf", "[Service]\nWatchdogSec=30\n")
    install(service)
    before = service.shows("MainPID")
    assert service.shows("StatusText").startswith("mic: ")
    assert "waiting for it" in service.shows("StatusText")
    service.run("sleep", "35")
    service.run("rm", "/etc/labmic.control")
    wait_for_labels(service)
    assert service.shows("MainPID") == before
    assert service.shows("NRestarts") == "0"


def test_logs_and_configuration_may_be_anywhere_and_have_any_name(service):
    config, folder = "/etc/my 100% $HOME \\ 'x'.toml", '/srv/logs/of "us" 5%'
    service.write(config, f"output = '{folder}'\n")
    service.run("install", "-d", "-o", "hearthlog", folder)
    install(service, "--config", config)
    wait_for_labels(service, folder)


def test_a_service_may_use_the_network_if_a_microphone_is_there(service):
    address = "http://127.0.0.1:8123/nursery.wav"
    service.write("/etc/home.toml", f"[[microphone]]\ndevice = '{address}'\n")
    install(service, "--config", "/etc/home.toml")
    sends = "ffmpeg -re -f lavfi -i anoisesrc=a=0.1 -f wav -listen 1"
    service.run(
        "systemd-run", "-q", "--unit=camera", "-p", "Restart=always", *sends.split(), address
    )
    wait_for_labels(service)
    service.run("systemctl", "stop", "camera")


def test_the_bridge_runs_as_a_user_of_its_own_who_may_only_read_the_logs(service):
    reported = 'readable_by = "group"\n[bridge.prometheus]\nport = 9177\n'
    reported += 'token_file = "/etc/prometheus-token"\n'
    service.write("/etc/home.toml", reported)
    service.write("/etc/prometheus-token", "a-token-of-the-figures\n")
    install(service, "--config", "/etc/home.toml")
    wait_for_labels(service)
    # Where Python was built with its library in a home, the service would find that of the system.
    library = "[Service]\nEnvironment=LD_LIBRARY_PATH=/opt/python/lib\n"
    service.write("/etc/systemd/system/hearthlog-bridge.service.d/python.conf", library)
    result = install(service, "--bridge", "--config", "/etc/home.toml")
    assert result.stdout == "/etc/systemd/system/hearthlog-bridge.service\n"
    requested = (
        "from urllib.request import Request, urlopen; shown = {'Authorization': "
        "'Bearer a-token-of-the-figures'}; print(urlopen(Request("
        "'http://127.0.0.1:9177/metrics', headers=shown)).read())"
    )
    python = f"{PREFIX}/bin/python"
    service.wait(
        lambda: (
            'listening{microphone="mic",node="home"} 1.0'
            in service.run(python, "-c", requested, check=False).stdout
        )
    )
    process = service.shows("MainPID", unit="hearthlog-bridge")
    who = service.run("stat", "-c", "%U", f"/proc/{process}").stdout.strip()
    assert who not in {"root", "hearthlog"}
    enter = ["nsenter", "-t", process, "-m"]  # as root, in what the service sees
    service.run(*enter, "ls", LOGS)
    assert "Read-only" in service.run(*enter, "touch", f"{LOGS}/x", check=False).stderr
    service.run("systemctl", "disable", "--now", "hearthlog-bridge")


@pytest.mark.parametrize(
    ("reported", "output"),
    [
        ("[bridge.ping]\nurl = 'http://x'\n", "who may not read the logs; say there readable_by"),
        ("", "has no output; add a table such as [bridge.mqtt]"),
        ("[bridge.mqtt]\n", "bridge.mqtt.host: is missing; write host = "),
        (
            "readable_by = 'group'\n[bridge.mqtt]\nhost = 'x'\nca_file = '/home/anna/ca'\n",
            "/home/anna/ca: ca_file is in a folder that the service does not see",
        ),
    ],
)
def test_a_bridge_that_would_not_run_is_refused_with_one_line(service, reported, output):
    service.write("/etc/home.toml", reported)
    result = install(service, "--bridge", "--config", "/etc/home.toml", check=False)
    assert result.returncode
    assert output in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_service_that_does_not_start_is_an_error_that_says_where_to_look(service):
    service.write(f"{UNIT}.d/broken.conf", "[Service]\nExecStartPre=false\n")
    result = install(service, check=False)
    assert result.returncode == 1
    expected = "hearthlog.service did not start; `journalctl -u hearthlog.service` says why"
    assert result.stderr == f"hearthlog: {expected}\n"


def test_a_service_takes_over_another_configuration_and_refuses_a_wrong_one(service):
    service.write("/etc/home.toml", "node = 'one'\n")
    install(service, "--config", "/etc/home.toml")
    wait_for_labels(service)
    process = service.shows("MainPID")
    service.write("/etc/home.toml", "node = 'one\n")
    service.run("systemctl", "reload", "hearthlog")
    output = ("journalctl", "-u", "hearthlog", "-o", "cat")
    service.wait(lambda: "keeps its present configuration" in service.run(*output).stdout)
    service.write("/etc/home.toml", "node = 'two'\n")
    service.run("systemctl", "reload", "hearthlog")
    service.wait(lambda: list(logs_of(service).rglob("two_*.active")))
    service.wait(lambda: service.shows("ActiveState") == "active")
    assert (service.shows("MainPID"), service.shows("NRestarts")) == (process, "0")
    assert not errors(logs_of(service))


def test_a_service_of_a_user_records_in_the_folder_it_was_installed_in(service):
    service.run("systemctl", "start", f"user@{USER_ID}")
    env = {"XDG_RUNTIME_DIR": f"/run/user/{USER_ID}", "HOME": "/home/anna"}
    how = {"user": "anna", "env": env}
    script = f"mkdir -p ~/hearing && cd ~/hearing && {PROGRAM} install-service --user"
    result = service.run("sh", "-c", script, **how)
    assert result.stdout == "/home/anna/.config/systemd/user/hearthlog.service\n"
    assert "loginctl enable-linger" in result.stderr
    wait_for_labels(service, "/home/anna/hearing/logs")
    status = service.run("systemctl", "--user", "show", "-P", "StatusText", "hearthlog", **how)
    assert status.stdout == "mic: listening\n"
    service.run("systemctl", "--user", "stop", "hearthlog", **how)
    assert not errors(logs_of(service, "/home/anna/hearing/logs"))


@pytest.mark.parametrize(
    ("before", "options", "output"),
    [
        ("true", "--account nobody-here", "there is no user 'nobody-here'; make one: useradd"),
        ("echo 'outputs = 1' > /etc/home.toml", "--config /etc/home.toml", "unknown key 'outputs'"),
        (
            "echo \"output = '/srv/none'\" > /etc/home.toml",
            "--config /etc/home.toml",
            "/srv/none: no such folder; make it, and give it to hearthlog",
        ),
        (
            "echo \"output = '/srv'\" > /etc/home.toml",
            "--config /etc/home.toml",
            "/srv: hearthlog may not write there; give it to them",
        ),
        (
            "echo \"model = 'none.safetensors'\" > /etc/home.toml",
            "--config /etc/home.toml",
            "none.safetensors: no such model file",
        ),
        (
            "touch /etc/home.toml; chmod 600 /etc/home.toml",
            "--config /etc/home.toml",
            "/etc/home.toml: cannot be read (Permission denied)",
        ),
        ("touch /home/anna/h.toml", "--config /home/anna/h.toml", "a folder that the service does"),
        ("echo '[Unit]' > " + UNIT, "", f"{UNIT}: was not written by hearthlog; move it away"),
        ("ln -s /dev/null " + UNIT, "", f"{UNIT}: was not written by hearthlog; move it away"),
    ],
)
def test_what_would_not_run_is_refused_with_one_line(service, before, options, output):
    service.run("rm", "-f", "/etc/home.toml")
    service.run("sh", "-c", before)
    result = install(service, *options.split(), check=False)
    assert result.returncode in {1, 2}
    assert result.stdout == ""
    assert output in result.stderr
    assert result.stderr.count("\n") == 1
    assert service.shows("ActiveState") == "inactive"


def test_only_root_installs_for_the_machine(service):
    result = install(service, user="anna", check=False)
    assert result.returncode == 1
    assert result.stderr.endswith("is installed by root: use sudo, or --user for one of your own\n")


def test_without_systemd_nothing_is_installed(hearthlog, tmp_path):
    result = hearthlog("install-service", env={"PATH": "", "XDG_CONFIG_HOME": str(tmp_path)})
    assert result.returncode == 1
    assert result.stderr.startswith("hearthlog: ")
    assert result.stderr.count("\n") == 1
    result = hearthlog(
        "install-service", "--user", env={"PATH": "", "XDG_CONFIG_HOME": str(tmp_path)}
    )
    assert result.stderr.startswith("hearthlog: systemd is missing")
    assert not list(tmp_path.iterdir())
