"""A camera in the network, by GStreamer: run with the Python of the system, as it has `gi`.

Its argument is a file of int16 samples at 16 kHz, one channel. It prints a port on which `/sound`
has the samples, `/film` noise and a picture and `/mute` a picture only, and one on which `/sound`
is for user `listener` with password `pass@word`.
"""

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

SOUND = (
    f'filesrc location="{sys.argv[1]}" ! rawaudioparse format=pcm pcm-format=s16le '
    "sample-rate=16000 num-channels=1 ! audioconvert ! rtpL16pay name=pay"
)
PICTURE = (
    "videotestsrc is-live=true ! video/x-raw,format=I420,width=64,height=64 ! jpegenc "
    "! rtpjpegpay name=pay"
)
NOISE = (
    "audiotestsrc is-live=true wave=white-noise samplesperbuffer=320 ! audio/x-raw,rate=16000 "
    "! audioconvert ! rtpL16pay name=pay"
)
MEDIA = {"/sound": f"{SOUND}0", "/film": f"{PICTURE}0 {NOISE}1", "/mute": f"{PICTURE}0"}


def serve(media, auth=None, permissions=None):
    """Serve some media on a port of the system's choice, and return it."""
    server = GstRtspServer.RTSPServer(address="127.0.0.1", service="0")
    for path, launch in media.items():
        factory = GstRtspServer.RTSPMediaFactory(launch=f"( {launch} )")
        if permissions is not None:
            factory.set_permissions(permissions)
        server.get_mount_points().add_factory(path, factory)
    server.set_auth(auth)
    server.attach(None)
    return server.get_bound_port()


def locked():
    """Return what lets one user in, and nobody else."""
    token = GstRtspServer.RTSPToken()
    token.set_string("media.factory.role", "listener")
    auth = GstRtspServer.RTSPAuth()
    auth.add_basic(GstRtspServer.RTSPAuth.make_basic("listener", "pass@word"), token)
    permissions = GstRtspServer.RTSPPermissions()
    for right in ("access", "construct"):
        permissions.add_permission_for_role("listener", f"media.factory.{right}", True)
    return auth, permissions


Gst.init(None)
sys.stdout.write(f"{serve(MEDIA)} {serve({'/sound': SOUND + '0'}, *locked())}\n")
sys.stdout.flush()
GLib.MainLoop().run()
