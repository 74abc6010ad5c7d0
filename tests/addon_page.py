"""Opens the page of the add-on in a browser, through the ingress: news come, and a tap is saved."""

import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

from servedhome import Phone
from viewers import browsing, patiently

ADDRESS = sys.argv[1]
BEATS = """
window.beats = 0;
new EventSource("events").addEventListener("beat", () => window.beats++);
"""

with (
    tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
    browsing("about:blank", Path(folder)) as browser,
):
    phone = Phone(browser)
    phone.open(SimpleNamespace(url=ADDRESS))
    assert phone.of("location.href") == ADDRESS
    for room in ("Kitchen", "Hall"):
        phone.shows("#heard", room)
    phone.of(BEATS)
    phone.until("window.beats >= 2")
    summary = 'document.querySelector("#events summary, #look summary")'
    phone.until(summary)
    phone.of(f"{summary}.click()")
    phone.until('document.querySelector("fieldset input[type=radio]")')
    phone.of('document.querySelector("fieldset input[type=radio]").click()')
    phone.of('document.querySelector("form button").click()')
    patiently(lambda: phone.of('document.querySelector("li.reviewed .said").innerText'), bool)
    assert phone.of("document.getElementById('trouble').hidden")
    assert phone.of("seen") == []
    sys.stdout.write(f"In a browser: {' '.join(phone.text('#heard').split())}\n")
