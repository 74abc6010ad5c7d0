"""Nodes of ROS 2: what a recorder writes, live on the graph, and labels of features from there."""
