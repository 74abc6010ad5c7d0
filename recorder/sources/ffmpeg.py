"""ffmpeg, which reads sound from the network: how it is started, and what it means when it ends."""

import ctypes
import re
import resource
import shutil
import signal
import subprocess
from urllib.parse import urlsplit

from hearthlog.recorder.addresses import public_name
from hearthlog.recorder.errors import SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_ANSWER_SECONDS = 10
_MOST_BYTES = 256_000_000  # of memory, whatever a server sends
_PROTOCOLS = {"rtsp": "tcp", "http": "http,https,tls,tcp", "https": "http,https,tls,tcp"}
# No playlists: those lead to other addresses, and to files.
_FORMATS = "rtsp,sdp,wav,w64,aiff,au,mp3,aac,flac,ogg,matroska,mov,mpegts"
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG

# The first that is found in what ffmpeg says: what it means, and what to do.
_MEANINGS = {
    "401 Unauthorized": "",  # depends on whether it was told a password
    "403 Forbidden": "may not be heard (403 Forbidden)",
    "404 Not Found": "is not there (404 Not Found); check the part after the host",
    "Failed to resolve hostname": "has a host that nobody knows; check its name",
    "Connection refused": "refuses the connection; check whether it is on, and its port",
    "timed out": "does not answer; check whether it is on and in this network",
    "No route to host|Network is unreachable": "cannot be reached; check the network",
    "certificate": "has a certificate that this machine does not trust",
    "TLS": "speaks no https; try http://",
    "matches no streams|454 Session": "has no sound; check whether its microphone is on",
    "unknown keyword 'option'": "needs a newer ffmpeg, 5.0 at least",
    "Invalid|prematurely|whitelist|not permitted|End of file|moov|Output file": (
        "sends nothing that is known as sound; check the part after the host"
    ),
}


def check_ffmpeg() -> None:
    """Check that there is an ffmpeg.

    Raises
    ------
    SourceError
        If there is none; it says how to get it.
    """
    if shutil.which("ffmpeg") is None:
        raise SourceError(
            "ffmpeg is missing, which reads sound from the network: "
            "install it (Debian: apt install ffmpeg)"
        )


def start_ffmpeg(address: str) -> subprocess.Popen[bytes]:
    """Start to read the first sound of an address, as int16 at 16 kHz, one channel.

    ffmpeg ends with the thread that starts it, also if that is killed.

    Parameters
    ----------
    address : str
        As `check_address` takes it.

    Returns
    -------
    subprocess.Popen
        Sound comes on standard output, reasons why none comes on standard error.
    """
    process = subprocess.Popen(  # noqa: S603
        [
            *("ffmpeg", "-nostdin", "-hide_banner", "-nostats", "-loglevel", "error"),
            *("-protocol_whitelist", f"pipe,{_PROTOCOLS[urlsplit(address).scheme]}"),
            *("-format_whitelist", f"concat,{_FORMATS}", "-threads", "1"),
            *("-f", "concat", "-safe", "0", "-i", "pipe:0", "-map", "0:a:0"),
            *("-ac", "1", "-ar", str(SAMPLE_RATE), "-f", "s16le", "pipe:1"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        start_new_session=True,  # Ctrl-C is for the recorder
        preexec_fn=_confine,  # noqa: PLW1509  it has one thread
    )
    # A list of one: arguments could be read by all users of the machine, and the address has a
    # password.
    assert process.stdin is not None
    process.stdin.write(_list_of_one(address).encode())
    process.stdin.close()
    return process


def explain(address: str, said: str) -> str:
    """Say why ffmpeg found no sound.

    Parameters
    ----------
    address : str
    said : str
        What it wrote to standard error, which may have the address in it.

    Returns
    -------
    str
        One line, without any of what it said.
    """
    said = said.replace(address, "")
    found = next((meaning for text, meaning in _MEANINGS.items() if re.search(text, said)), None)
    if found == "":
        found = (
            "refuses the user name or the password"
            if urlsplit(address).username is not None
            else "wants a user name and a password, as in rtsp://user:password@camera/stream"
        )
    return f"{public_name(address)} {found or 'cannot be read by ffmpeg'}"


def _list_of_one(address: str) -> str:
    scheme = urlsplit(address).scheme
    options = {"protocol_whitelist": _PROTOCOLS[scheme], "format_whitelist": _FORMATS}
    limit = str(_ANSWER_SECONDS * 1_000_000)
    if scheme == "rtsp":
        options |= {"rtsp_transport": "tcp", "allowed_media_types": "audio", "timeout": limit}
    else:
        options |= {"rw_timeout": limit, "tls_verify": "1"}
    quoted = address.replace("'", r"'\''")
    lines = ["ffconcat version 1.0", f"file '{quoted}'"]
    lines += [f"option {name} {value}" for name, value in options.items()]
    return "\n".join(lines) + "\n"


def _confine() -> None:
    """Limit the memory of this process, and end it with its parent."""
    resource.setrlimit(resource.RLIMIT_DATA, (_MOST_BYTES, _MOST_BYTES))
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
