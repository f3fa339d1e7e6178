"""STAR: hierarchical reinforcement learning whose goal space refines itself by reachability."""

__version__ = "0.1.0"
