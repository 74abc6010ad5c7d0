"""A page of somebody else, in a browser of this machine, reads nothing of the home.

It lets its name point to this machine, and is told every port and the secret: all but an address.
"""

import json
import os
import subprocess
from contextlib import contextmanager

import psutil
import pytest
from conftest import HEARTHLOG
from homelife import at, write_day
from shortsounds import DAY
from viewers import browsing, display, patiently, reviewing

from hearthlog.analyzer.http import HOST, free_port

__all__ = ["display"]  # fixture

STRANGER = "stranger.example"
HOSTS = [STRANGER, HOST, "localhost", "0.0.0.0", "[::1]"]
MICROPHONE = "bedroom_of_ann"
DATA = "rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
PAGE = ["", "description", "re_viewer.js", "re_viewer_bg.wasm"]
FLAGS = [
    f"--host-resolver-rules=MAP {STRANGER} {HOST}",
    # Other browsers, and older ones, let every page reach this machine.
    "--disable-features=LocalNetworkAccessChecks",
]
SCRIPT = """<script>
async function read(url, mode) {
  const grpc = !url.endsWith("/ReadMessages") || mode === "no-cors" ? {} : {
    method: "POST", body: new Uint8Array(5),
    headers: { "content-type": "application/grpc-web+proto", "x-grpc-web": "1" },
  };
  const found = { url, status: 0, text: "" };
  try {
    const answer = await fetch(url, { ...grpc, mode, signal: AbortSignal.timeout(2000) });
    found.status = answer.status;
    const reader = answer.body.getReader(), decoder = new TextDecoder("latin1");
    for (let part; found.text.length < 1e6 && !(part = await reader.read()).done;)
      found.text += decoder.decode(part.value);
  } catch (error) { found.error = String(error); }
  return found;
}
function look(url) {
  return new Promise((resolve) => {
    const socket = new WebSocket(url, ["foxglove.sdk.v1"]);
    socket.onmessage = ({ data }) => { resolve({ url, text: String(data) }); socket.close(); };
    socket.onclose = () => resolve({ url, text: "" });
  }).catch((error) => ({ url, text: "", error: String(error) }));
}
</script>"""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """The logs of an hour."""
    folder = tmp_path_factory.mktemp("hour") / "logs"
    events = [(at("20:50") + 20 * number, 10, "coughing", 0.9) for number in range(29)]
    write_day(folder, DAY, events, microphone=MICROPHONE, hours=[20])
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with browsing("about:blank", tmp_path_factory.mktemp("browser"), flags=FLAGS) as page:
        yield page


def read(browser, urls, mode="cors"):
    """Let the page that is open read addresses."""
    calls = f"Promise.all({json.dumps(urls)}.map((url) => read(url, '{mode}')))"
    return browser.wait_for(calls)


def is_reported(browser, url):
    """Whether the page that is open reads something of the home."""
    (found,) = read(browser, [url])
    return MICROPHONE in found["text"]


def listening(process):
    """Addresses and ports at which a process and those that it started listen."""
    parent = psutil.Process(process.pid)
    return {
        tuple(connection.laddr)
        for each in (parent, *parent.children(recursive=True))
        for connection in each.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def others(places):
    """Addresses and ports at which other processes listen."""
    every = (each for each in psutil.net_connections("inet") if each.status == psutil.CONN_LISTEN)
    return {tuple(each.laddr) for each in every} - places


@contextmanager
def watching(logs, *options, **environment):
    process = subprocess.Popen(
        [*HEARTHLOG, "watch", logs, *options],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=60)


def check_hidden(browser, process, page=""):
    """Check that data are there for a page of this machine, and for no other one.

    Returns
    -------
    set of (str, int)
        Where the process listens.
    """
    browser.open_as(f"http://{HOST}:{free_port()}/", SCRIPT)
    patiently(
        lambda: any(
            is_reported(browser, f"http://{address}:{port}/{DATA}")
            for address, port in listening(process)
        ),
        bool,
    )
    names = [DATA, *PAGE, *(f"{page.split('/')[3]}/{name}" for name in PAGE if page)]
    places = listening(process)
    for _, port in places:
        browser.open_as(f"http://{STRANGER}:{port}/", SCRIPT)
        urls = [f"http://{host}:{port}/{name}" for host in HOSTS for name in names]
        for mode in ("cors", "no-cors"):
            for found in read(browser, urls, mode):
                # The same port of another address may be that of another process.
                assert found["status"] in {0, 404} or (HOST, port) in others(places), found
                assert MICROPHONE not in found["text"], found
    return places


def check_page(browser, address):
    """Check that the page reads what it needs."""
    browser.open_as(f"{address}stand-in", SCRIPT)
    found = read(browser, [f"{address}{name}" for name in PAGE])
    assert [each["status"] for each in found] == [200] * len(PAGE)
    assert "/proxy" in found[1]["text"]


def test_a_stranger_reads_a_server_at_the_usual_address(logs, browser):
    port = free_port()
    with watching(logs, "--serve", "--bind", HOST, "--port", str(port)) as watcher:
        patiently(lambda: listening(watcher), bool)
        browser.open_as(f"http://{STRANGER}:{port}/", SCRIPT)
        patiently(lambda: is_reported(browser, f"http://{STRANGER}:{port}/{DATA}"), bool)


def test_a_stranger_reads_nothing_of_a_review_in_a_window(logs, browser, display):
    with reviewing(logs, DISPLAY=display) as review:
        review.wait_for("drag a span")
        ((address, _),) = check_hidden(browser, review.process)
        assert address != HOST


def test_a_stranger_reads_nothing_of_a_review_in_a_browser(logs, browser):
    with reviewing(logs, "--web", DISPLAY="", WAYLAND_DISPLAY="") as review:
        address = review.wait_for("open http").split()[-1]
        places = check_hidden(browser, review.process, address)
        assert sorted(place == HOST for place, _ in places) == [False, False, True]
        check_page(browser, address)


def test_a_stranger_reads_nothing_of_what_is_watched(logs, browser, display):
    with watching(logs, DISPLAY=display) as watcher:
        patiently(lambda: listening(watcher), lambda places: len(places) == 2)
        assert HOST not in dict(check_hidden(browser, watcher))


def test_a_stranger_reads_nothing_of_what_is_watched_in_a_browser(logs, browser):
    with watching(logs, "--web", DISPLAY="", WAYLAND_DISPLAY="") as watcher:
        address = watcher.stderr.readline().split()[-1]
        patiently(lambda: listening(watcher), lambda places: len(places) == 4)
        check_hidden(browser, watcher, address)
        check_page(browser, address)


def look(browser, urls):
    """Let the page that is open connect as Foxglove does; return what it is told first."""
    calls = f"Promise.all({json.dumps(urls)}.map(look))"
    return {found["url"]: found["text"] for found in browser.wait_for(calls)}


def test_a_stranger_is_told_nothing_by_the_server_for_foxglove(logs, browser):
    port = free_port()
    with watching(logs, "--foxglove", "--port", str(port)) as watcher:
        address = watcher.stderr.readline().split()[-1]
        behind = address.rpartition("/")[2]
        for page in ("https://app.foxglove.dev/", f"http://localhost:{port}/"):
            browser.open_as(page, SCRIPT)
            assert '"hearthlog"' in look(browser, [address])[address]
        ports = {place for _, place in listening(watcher)}
        assert len(ports) == 2
        for page in (f"http://{STRANGER}:{port}/", f"https://{STRANGER}/"):
            browser.open_as(page, SCRIPT)
            urls = [f"ws://{host}:{each}/{behind}" for host in HOSTS for each in ports]
            assert set(look(browser, urls).values()) == {""}
