"""A network of sounds is fetched when somebody asks: whole, the right one, for all to read."""

import fcntl
import hashlib
import os
import stat
from dataclasses import replace

import numpy as np
import pytest
from certificates import Authority
from fileserver import file_server
from typer.testing import CliRunner

from hearthlog.models.embedding.networks import NETWORKS, YAMNET, NetworkFile, find_network
from hearthlog.tools import download as downloads
from hearthlog.tools.cli.main import make_app
from hearthlog.tools.download import DownloadError, download

DATA = np.random.default_rng(5).bytes(300_000)
SHA256 = hashlib.sha256(DATA).hexdigest()


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(downloads, "_WAIT_SECONDS", (0.01, 0.02, 0.03))
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def server():
    with file_server() as server:
        server.data = DATA
        yield server


@pytest.fixture
def path(tmp_path):
    return tmp_path / "data" / "networks" / "yamnet.tflite"


def get(server, path):
    shares = []
    download(server.url, path, len(DATA), SHA256, shares.append)
    assert shares[-1] == 1.0


def parts(path):
    return sorted(path.parent.glob(".*"))


def test_a_file_is_whole_and_all_may_read_it_whatever_the_umask(server, path):
    before = os.umask(0o077)
    try:
        get(server, path)
    finally:
        os.umask(before)
    assert path.read_bytes() == DATA
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert {stat.S_IMODE(path.parents[n].stat().st_mode) for n in (0, 1)} == {0o755}
    assert list(path.parent.iterdir()) == [path]
    assert server.requested == [None]


@pytest.mark.parametrize("mood", ["no length", "slow", "moved"])
def test_servers_differ(server, path, mood):
    server.moods = [mood, "well"]
    get(server, path)
    assert path.read_bytes() == DATA


def test_what_ends_early_is_gone_on_with(server, path):
    server.moods = [100_000, 50_000, "503", "well"]
    get(server, path)
    assert path.read_bytes() == DATA
    assert server.requested == [None, "bytes=100000-", "bytes=150000-", "bytes=150000-"]


@pytest.mark.parametrize("mood", ["no ranges", "another range"])
def test_a_server_that_cannot_go_on_is_asked_for_all_of_it(server, path, mood):
    server.moods = [100_000, mood, "well"]
    get(server, path)
    assert path.read_bytes() == DATA


def test_what_was_interrupted_is_private_and_is_gone_on_with_by_the_next_command(server, path):
    server.moods = [100_000, 0]
    with pytest.raises(DownloadError, match=r"it ended early\); the same command resumes"):
        get(server, path)
    assert not path.exists()
    (part,) = parts(path)
    assert part.read_bytes() == DATA[:100_000]
    assert stat.S_IMODE(part.stat().st_mode) == 0o600
    server.moods, server.requested = ["well"], []
    get(server, path)
    assert server.requested == ["bytes=100000-"]
    assert path.read_bytes() == DATA
    assert parts(path) == []


@pytest.mark.parametrize("rest", [DATA[:200_000][::-1], DATA[:-7] + bytes(7), DATA + b"more"])
def test_remains_of_another_file_do_no_harm(server, path, rest):
    path.parent.mkdir(parents=True)
    path.with_name(f".{path.name}.{SHA256[:12]}.part").write_bytes(rest)
    get(server, path)
    assert path.read_bytes() == DATA


def test_a_server_that_stalls_is_asked_again(server, path, monkeypatch):
    monkeypatch.setattr(downloads, "_TIMEOUT_SECONDS", 0.3)
    server.moods = ["stalls", "well"]
    get(server, path)
    assert path.read_bytes() == DATA
    monkeypatch.setattr(downloads, "_MOST_TRIES", 3)  # each brings something
    server.moods = ["stalls"]
    path.unlink()
    with pytest.raises(DownloadError, match=r"nothing came for 0\.3 s"):
        download(server.url, path, len(DATA), SHA256)


def test_what_trickles_is_given_up(server, path, monkeypatch):
    monkeypatch.setattr(downloads, "_TIMEOUT_SECONDS", 0.2)
    monkeypatch.setattr(downloads, "_LEAST_SPEED", 10_000_000)
    monkeypatch.setattr(downloads, "_MOST_TRIES", 2)
    server.moods = ["slow"]
    with pytest.raises(DownloadError, match="it comes too slowly"):
        download(server.url, path, len(DATA), SHA256)


@pytest.mark.parametrize(
    ("moods", "data", "words"),
    [
        (["404"], DATA, r"is not there \(the server says 404 Not Found\)"),
        (["401"], DATA, "the server says 401"),
        (["500"], DATA, r"cannot be downloaded \(the server says 500"),
        (["well"], DATA[:-1] + b"?", "differs from the expected file .its sha256"),
        (
            ["well"],
            DATA + b"more",
            r"from the expected file \(300,004 bytes, not 300,000\)",
        ),
        (["well"], DATA[:1000], r"differs from the expected file \(1,000 bytes, not 300,000\)"),
        (["no length"], DATA * 2, r"is larger than the expected file \(300,000 bytes\)"),
        (["no length"], DATA[:0], "cannot be downloaded .it ended early"),
        (["moved to http://example.org/x"], DATA, "not an https:// address"),
        (["moved to file:///etc/passwd"], DATA, "'file:///etc/passwd' is not allowed"),
        (["moved"], DATA, "the server says 302"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_has_the_name(server, path, moods, data, words):
    server.moods, server.data = moods, data
    with pytest.raises(DownloadError, match=words) as error:
        download(server.url, path, len(DATA), SHA256)
    assert len(str(error.value).splitlines()) == 1
    assert not path.exists()
    assert parts(path) == []


def test_the_file_before_stays_where_the_new_one_is_wrong(server, path):
    path.parent.mkdir(parents=True)
    path.write_bytes(b"before")
    server.data = DATA[:-1] + b"?"
    with pytest.raises(DownloadError):
        download(server.url, path, len(DATA), SHA256)
    assert path.read_bytes() == b"before"
    server.data = DATA
    get(server, path)
    assert path.read_bytes() == DATA


def test_https_is_of_a_server_that_is_trusted_and_leads_nowhere_less_safe(
    server, path, tmp_path, monkeypatch
):
    authority = Authority(tmp_path, "authority")
    with file_server(authority.sign("server")) as safe:
        safe.data = DATA
        with pytest.raises(
            DownloadError, match=r"no certificate that this machine trusts \(.*clock"
        ):
            get(safe, path)
        assert safe.requested == []
        monkeypatch.setenv("SSL_CERT_FILE", str(authority.file))
        get(safe, path)
        assert path.read_bytes() == DATA
        safe.moods = [f"moved to {server.url}"]
        path.unlink()
        with pytest.raises(DownloadError, match="not an https:// address"):
            get(safe, path)
        assert server.requested == []


@pytest.mark.parametrize("url", ["http://example.org/x", "ftp://example.org/x", "file:///x", "x"])
def test_other_addresses_are_not_opened(path, url):
    with pytest.raises(DownloadError, match="not an https:// address"):
        download(url, path, 1, SHA256)


def test_nobody_there_is_told_after_some_tries(server, path):
    url = server.url.replace("network", "x")
    with file_server() as gone:
        url = gone.url
    with pytest.raises(DownloadError, match=r"cannot be downloaded \(Connection refused\)$"):
        download(url, path, 1, SHA256)


def test_two_at_once_do_not_mix(server, path):
    path.parent.mkdir(parents=True)
    with path.with_name(f".{path.name}.{SHA256[:12]}.part").open("wb") as part:
        fcntl.flock(part, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another command is fetching it"):
            download(server.url, path, len(DATA), SHA256)


def test_no_link_is_followed(server, path, tmp_path):
    path.parent.mkdir(parents=True)
    path.with_name(f".{path.name}.{SHA256[:12]}.part").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DownloadError, match="cannot be written"):
        download(server.url, path, len(DATA), SHA256)
    assert not (tmp_path / "elsewhere").exists()


def test_a_folder_that_cannot_be_made_is_one_line(server, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DownloadError, match="cannot be written"):
        download(server.url, tmp_path / "file" / "networks" / "x", len(DATA), SHA256)


@pytest.fixture
def known(server, tmp_path, monkeypatch):
    """A network whose address is the server's, and whose file no runtime takes."""
    files = (NetworkFile(SHA256, len(DATA), server.url), *YAMNET.files[1:])
    network = replace(YAMNET, files=files)
    monkeypatch.setitem(NETWORKS._loaded, "yamnet", network)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_DATA_DIRS", str(tmp_path / "all"))
    return network


def run(*words):
    return CliRunner().invoke(make_app(["models"]), ["models", "fetch", *map(str, words)])


def test_the_verb_says_whose_it_is_and_where_it_lies(known, server):
    assert known.files[0].url == server.url
    done = run("yamnet")
    path = find_network("yamnet")
    assert path.read_bytes() == DATA
    assert done.stdout == f"{path}\n"
    assert "YAMNet, Google LLC" in done.stderr
    assert "its licence is Apache-2.0" in done.stderr
    assert "fetching 0.3 MB from 127.0.0.1" in done.stderr
    assert done.exit_code == 3, "it is the known file, but no network"
    server.moods = ["404"]
    assert "it is already installed" in run("yamnet").stderr
    assert str(path) in run().stdout


@pytest.mark.parametrize("uid", [0, 1000])
def test_root_fetches_for_all_users(known, tmp_path, monkeypatch, uid):
    del known
    monkeypatch.setattr("os.geteuid", lambda: uid)
    run("yamnet")
    assert find_network("yamnet").is_relative_to(tmp_path / ("all" if uid == 0 else "own"))


def test_without_a_name_networks_are_listed(known):
    del known
    assert "not there" in run().stdout
    assert "Apache-2.0" in run().stdout
    assert run("--from", "x").exit_code == 2


def test_a_file_that_is_no_network_is_not_taken(known, tmp_path):
    file = tmp_path / "yamnet.tflite"
    for content, words in ((b"", "it has 0 bytes, not"), (DATA[::-1], "its sha256 begins with")):
        file.write_bytes(content)
        done = run("yamnet", "--from", file)
        assert words in str(done.exception)
    assert "no such network" in str(run("yamnet", "--from", tmp_path / "x").exception)
    assert "Is a directory" in str(run("yamnet", "--from", tmp_path).exception)
    assert find_network(known.name) is None


def test_a_network_without_an_address_is_brought(known, tmp_path, monkeypatch):
    files = (NetworkFile(SHA256, len(DATA)),)
    monkeypatch.setitem(NETWORKS._loaded, "yamnet", replace(known, files=files))
    assert "give its file with --from" in str(run("yamnet").exception)
    (tmp_path / "x").write_bytes(DATA)
    run("yamnet", "--from", tmp_path / "x")
    assert find_network("yamnet").read_bytes() == DATA
