"""The nodes as programs: a stop request during loading ends them cleanly."""

import os
import signal
import sys
from importlib import import_module


def live() -> None:
    """Run the node that publishes what a recorder writes."""
    _run("live")


def label() -> None:
    """Run the node that labels features."""
    _run("label")


def _run(name: str) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    try:
        import_module("rclpy")
        import_module("hearthlog.schemas")
    except ImportError as error:
        missing = str(error.name).partition(".")[0]
        how = {
            "rclpy": "source /opt/ros/jazzy/setup.bash, or that of your ROS 2",
            "hearthlog": "activate the environment in which hearthlog is installed",
        }.get(missing, "install it")
        sys.exit(f"hearthlog_ros: no {missing} for {sys.executable}: {how}")
    import_module(f"hearthlog_ros.{name}").main()
