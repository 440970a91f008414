"""UWB modules and ROS 2: pure parsers, one file a family (`families.py`): bytes in, measured distances out.

Only `sources.py` touches ports, files and a clock. Importing the package loads none of it.
"""
