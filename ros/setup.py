"""The ament_python package: what colcon installs."""

from glob import glob

from setuptools import setup

NAME = "cvo_edge_ros"
SHARE = f"share/{NAME}"

setup(
    name=NAME,
    version="0.1.0",
    description="The node of cvo-edge for ROS 2",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *((f"{SHARE}/{folder}", glob(f"{folder}/*")) for folder in ("launch", "config", "rviz")),
    ],
    # Not cvo-edge: colcon would look for a ROS package of that name.
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": [f"odometry = {NAME}.node:main"]},
)
