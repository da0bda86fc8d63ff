"""``python -m ember_ros`` is ``ember``."""

from ember_ros.entry_points import ember

if __name__ == "__main__":
    ember()
