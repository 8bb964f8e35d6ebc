"""The map in a running ROS 2 graph: what `mapfold ros` publishes."""
