"""Robots, agents and faults in one scan: acting, residuals of the predictions, transfer to another robot."""
