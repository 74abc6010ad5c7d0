"""What to install where a package is missing that the recorder alone does without."""

_CLUSTER = ("dask", "distributed", "fsspec", "s3fs", "upath")
_EXTRAS = {
    "rerun": "viewer",
    "rerun_cli": "viewer",
    "foxglove": "foxglove",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "paho": "bridge",
    "apprise": "bridge",
} | dict.fromkeys(_CLUSTER, "cluster")


def remedy(module: str) -> str:
    """Say what to do where a module cannot be imported.

    Parameters
    ----------
    module : str
        Its import name, such as `sklearn`, or that of a part of it.
    """
    extra = _EXTRAS.get(module.partition(".")[0], "analyzer")
    return f"try: pip install '.[{extra}]' in a clone of hearthlog"
