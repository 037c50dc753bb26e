"""What everything stands on: devices, threads, arrays, files, memory, checks and names."""
