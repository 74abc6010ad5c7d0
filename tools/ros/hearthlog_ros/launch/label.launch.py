"""`ros2 launch hearthlog_ros label.launch.py microphone:=mic model:=general`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the node that labels the features of a microphone."""
    names = "microphone", "model"
    return LaunchDescription(
        [
            DeclareLaunchArgument("microphone", default_value="mic"),
            DeclareLaunchArgument("model", description="a model file, or a starter's name"),
            Node(
                package="hearthlog_ros",
                executable="label",
                output="screen",
                parameters=[{name: LaunchConfiguration(name) for name in names}],
            ),
        ]
    )
