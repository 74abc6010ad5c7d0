"""How colcon installs the nodes."""

from setuptools import setup

setup(
    name="hearthlog_ros",
    version="0.3.0",
    packages=["hearthlog_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/hearthlog_ros"]),
        ("share/hearthlog_ros", ["package.xml"]),
        ("share/hearthlog_ros/config", ["config/diagnostics.yaml"]),
        ("share/hearthlog_ros/launch", ["launch/live.launch.py", "launch/label.launch.py"]),
    ],
    entry_points={
        "console_scripts": [
            "live = hearthlog_ros.start:live",
            "label = hearthlog_ros.start:label",
        ]
    },
)
