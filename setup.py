"""What colcon reads to build the package; pip reads pyproject.toml, which says the same.

test/test_packaging.py holds the two against each other. There is no setup.cfg: the usual
``install_scripts`` there is not needed, since ``ros2 run`` finds the wrappers below lib/.
"""

from glob import glob

from setuptools import find_packages, setup

setup(
    name="ember_ros",
    # A literal, because the ROS release tools bump it here and in package.xml.
    version="0.1.0",
    description="Legs as reinforcement-learning modules on a ROS 2 graph",
    license="Apache-2.0",
    maintainer="ember_ros maintainers",
    maintainer_email="ember_ros@example.org",
    python_requires=">=3.10",
    packages=[
        *find_packages(include=["ember_ros*", "sim_node*", "leg_node*", "cpg_node*"]),
        "ember_ros.data",
    ],
    package_dir={"ember_ros.data": "bags"},
    # Only what is named: launch files and wrappers go to share/ and lib/; parameter files are read
    # by `ember` from the package, and by `ros2 run` from share/; data/ by both from the package.
    include_package_data=False,
    package_data={
        "ember_ros": ["config/*.yaml", "py.typed"],
        "ember_ros.data": ["*", "walk/*"],
        **{room: ["py.typed"] for room in ("sim_node", "leg_node", "cpg_node")},
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["ember_ros/resource/ember_ros"]),
        ("share/ember_ros", ["package.xml"]),
        ("share/ember_ros/launch", sorted(glob("ember_ros/launch/*.launch.py"))),
        ("share/ember_ros/config", sorted(glob("ember_ros/config/*.yaml"))),
        ("lib/ember_ros", sorted(glob("ember_ros/resource/lib/*"))),
    ],
    zip_safe=False,
    entry_points={"console_scripts": ["ember = ember_ros.entry_points:ember"]},
)
