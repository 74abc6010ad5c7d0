"""`ros2 launch hearthlog_ros live.launch.py folder:=/var/lib/hearthlog/logs`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return the node that publishes what a recorder writes."""
    delay = ParameterValue(LaunchConfiguration("delay"), value_type=float)
    return LaunchDescription(
        [
            DeclareLaunchArgument("folder", description="where a recorder writes its logs"),
            DeclareLaunchArgument("delay", default_value="1.5", description="seconds; 0: at once"),
            Node(
                package="hearthlog_ros",
                executable="live",
                output="screen",
                parameters=[{"folder": LaunchConfiguration("folder"), "delay": delay}],
            ),
        ]
    )
