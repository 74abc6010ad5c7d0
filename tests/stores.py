"""Stores for the tests of logs that lie elsewhere: a server that speaks S3, and memory."""

import itertools
import threading
from pathlib import Path
from uuid import uuid4

import pytest

from hearthlog.analyzer.logs.locations import location


@pytest.fixture(scope="session")
def s3_account() -> dict[str, str]:
    """Environment in which clients find an S3 server, on a port of its own."""
    from moto.server import ThreadedMotoServer  # noqa: PLC0415  takes half a second

    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield account(f"http://{host}:{port}")
    server.stop()


@pytest.fixture
def throttled_account() -> dict[str, str]:
    """Environment of an S3 server that answers every fourth request with `SlowDown`."""
    from moto.server import DomainDispatcherApplication, create_backend_app  # noqa: PLC0415
    from werkzeug.serving import make_server  # noqa: PLC0415

    moto = DomainDispatcherApplication(create_backend_app)
    requested = itertools.count()

    def application(environ, start_response):
        if next(requested) % 4:
            return moto(environ, start_response)
        start_response("503 Slow Down", [("Content-Type", "application/xml")])
        return [b"<Error><Code>SlowDown</Code><Message>Reduce your request rate.</Message></Error>"]

    server = make_server("127.0.0.1", 0, application, threaded=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield account(f"http://127.0.0.1:{server.server_port}")
    server.shutdown()
    thread.join()
    assert next(requested) > 4


def account(endpoint: str) -> dict[str, str]:
    """Make the environment in which clients find an S3 server."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "resident",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }


@pytest.fixture
def bucket(s3_account, monkeypatch) -> Path:
    """A bucket of its own, empty; processes that are started find it, too."""
    from s3fs import S3FileSystem  # noqa: PLC0415  takes half a second

    for name, value in s3_account.items():
        monkeypatch.setenv(name, value)
    S3FileSystem.clear_instance_cache()  # the environment is no part of its key
    name = f"homes-{uuid4()}"
    S3FileSystem().mkdir(name)
    yield location(f"s3://{name}")
    S3FileSystem.clear_instance_cache()


@pytest.fixture
def in_memory() -> Path:
    """A folder in the memory of this process."""
    folder = location(f"memory://{uuid4()}")
    yield folder
    if folder.exists():
        folder.fs.rm(folder.path, recursive=True)


def put(folder: Path, store: Path) -> Path:
    """Copy a folder of logs to a store, file by file."""
    for path in sorted(folder.rglob("*.mcap*")):
        there = store.joinpath(*path.relative_to(folder).parts)
        there.fs.pipe_file(there.path, path.read_bytes())
    return store
