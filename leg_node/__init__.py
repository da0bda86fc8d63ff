"""One leg: it senses, acts, is rewarded and learns by itself, from what is mounted on it.

All files but ``node.py`` and ``table_node.py`` are pure: no ROS, no PyBullet, and no way to know
of another leg.
"""
