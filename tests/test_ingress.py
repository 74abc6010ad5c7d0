"""The page of the home through the ingress of a real Home Assistant, and a stand-in Supervisor."""

import subprocess
from contextlib import contextmanager
from http.client import HTTPConnection
from types import SimpleNamespace

import pytest
from homeassistant import hass_of, versions
from microphones import DIES_WITH_PARENT
from servedhome import Phone, serving
from viewers import browsing
from waiting import wait_for

from hearthlog.analyzer.http import free_port

PATH = "/api/hassio_ingress/abc123/"
# The view of the integration hassio alone, as all of it would need all of the Supervisor, and what
# the Supervisor does with a request.
INGRESS = """
import sys
import aiohttp
from aiohttp import web
from homeassistant.components.hassio.ingress import HassIOIngress

port, page = sys.argv[1:]
DROPPED = {"Content-Length", "Transfer-Encoding", "Content-Encoding"}

def kept(fields):
    return {name: value for name, value in fields.items() if name not in DROPPED}

async def application():
    session = aiohttp.ClientSession()
    view = HassIOIngress(f"127.0.0.1:{port}", session)

    async def home_assistant(request):
        return await getattr(view, request.method.lower())(request, **request.match_info)

    async def supervisor(request):
        url = f"http://127.0.0.1:{page}/{request.match_info['path']}"
        async with session.request(
            request.method, url, headers=kept(request.headers), params=request.query,
            data=await request.read(), allow_redirects=False,
        ) as found:
            if "Content-Length" in found.headers:
                body = await found.read()
                return web.Response(status=found.status, headers=kept(found.headers), body=body)
            response = web.StreamResponse(status=found.status, headers=kept(found.headers))
            await response.prepare(request)
            async for block in found.content.iter_any():
                await response.write(block)
            return response

    found = web.Application()
    found.router.add_route("*", view.url, home_assistant)
    found.router.add_route("*", "/ingress/{token}/{path:.*}", supervisor)
    return found

web.run_app(application(), host="127.0.0.1", port=int(port), print=None)
"""


def answer(port, path, **fields):
    """Return the answer of an ingress to a browser that can read compressed pages."""
    connection = HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", path, headers={"Accept-Encoding": "gzip, deflate", **fields})
    return connection.getresponse()


@contextmanager
def ingress(version, page_port):
    """Yield the port of the ingress of a Home Assistant."""
    port = free_port()
    python = hass_of(version).with_name("python")
    command = [*DIES_WITH_PARENT, python, "-Ic", INGRESS, str(port), str(page_port)]
    process = subprocess.Popen(command)

    def answers():
        assert process.poll() is None
        try:
            return answer(port, PATH).status
        except OSError:
            return 0

    try:
        wait_for(answers)
        yield port
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("version", versions())
def test_the_page_works_through_the_ingress_of_home_assistant_since_2026_3(version, tmp_path):
    with serving(tmp_path / "home") as home, ingress(version, home.port) as port:
        home.log.write_segment("coughing", 60, 5)
        if tuple(map(int, version.split("."))) < (2026, 3):
            # Compressed, the news stay in the buffer of the ingress.
            news = answer(port, f"{PATH}events", Cookie=home.cookie())
            assert news.headers["Content-Encoding"] == "deflate"
            return
        with browsing("about:blank", tmp_path / "browser") as browser:
            phone = Phone(browser)
            phone.open(SimpleNamespace(url=f"http://127.0.0.1:{port}{PATH}?token={home.token}"))
            home.log.hears("speech")
            phone.shows("#heard", "Talking")
            phone.until('document.querySelector("#look summary")')
            phone.of('document.querySelector("#look summary").click()')
            phone.until('document.querySelector("#look input[type=radio]")')
            phone.of('document.querySelector("#look input[type=radio]").click()')
            phone.of('document.querySelector("#look form button").click()')
            phone.until('document.querySelector("li.reviewed")')
            assert len(home.marks()) == 1
            assert phone.of("seen") == []
