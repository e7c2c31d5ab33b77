"""The network of the suite's own policy; needs torch, not LeRobot, whose import takes seconds."""
