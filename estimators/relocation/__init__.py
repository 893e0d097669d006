"""Where the robot is when nothing says so: at an unknown start, and after a filter has lost it.

Odometry knows the shape of the last seconds' way, ranges hold it to the anchors. Both together are solved for
the one pose that is missing, without any filter, so that every filter can be set to it.
"""
