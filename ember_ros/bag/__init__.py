"""Bags: the record of a run, from which it is replayed to the bit and learnt from again.

Only ``inquiry`` and the two node files import ROS; the rest reads and writes bags without it.
"""
