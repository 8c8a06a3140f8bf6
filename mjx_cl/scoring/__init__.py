"""From traces to numbers, in NumPy on the host: alarms and latency, recovery, intervals."""
