"""Start the node, and rviz on request.

ros2 launch cvo_edge_ros odometry.launch.py bundle:=/path image_topic:=/camera/image_raw

An argument that is not given leaves the parameter to the file ``params``.
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

PARAMETERS = ("bundle", "image_topic", "camera_info_topic", "base", "map")


def generate_launch_description() -> LaunchDescription:
    """Return the description."""
    share = FindPackageShare("cvo_edge_ros")
    defaults = {
        "params": PathJoinSubstitution([share, "config", "params.yaml"]),
        "rviz": "false",
        "use_sim_time": "false",
        **dict.fromkeys(PARAMETERS, ""),
    }
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "cvo_edge.rviz"])],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    declared = [DeclareLaunchArgument(name, default_value=v) for name, v in defaults.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=odometry), rviz])


def odometry(context: LaunchContext) -> list[Node]:
    """Return the node with the parameters that were given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    parameters = {name: value for name, value in given.items() if value}
    parameters["use_sim_time"] = LaunchConfiguration("use_sim_time").perform(context) == "true"
    return [
        Node(
            package="cvo_edge_ros",
            executable="odometry",
            name="cvo_edge",
            output="screen",
            parameters=[LaunchConfiguration("params"), parameters],
        )
    ]
