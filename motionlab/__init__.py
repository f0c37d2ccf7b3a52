"""motionlab: functions over tensors for studying human motion priors."""

__version__ = "0.1.0"
