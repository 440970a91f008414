"""The edges: the only files of the flying process that import Zenoh and pymavlink."""
