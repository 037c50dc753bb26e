"""What everything stands on: devices, threads, arrays, files, memory, checks and names."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "arrays": "array_bytes array_view as_points",
        "checks": (
            "axis_index checked_bounds checked_easing checked_number checked_positive checked_step "
            "checked_vector checked_whole listed warn_caller"
        ),
        "devices": (
            "MIN_SPARE RecordedLaunch RecordedLaunches SPARE_FRAMES SpareMemory half_texture "
            "kernel_label launch module_block_dim recorded_launches resolve_device"
        ),
        "files": "atomic_path file_stamp read_limited",
        "kernel_files": (
            "FOLDER MOVED copy_kernel find_kernel kernel_call kernel_groups "
            "kernel_names kernel_source kernel_summary native_files"
        ),
        "memory": "MEASURED_EVERY MemoryShortage LRUCache UNKNOWN free_host_bytes",
        "modules": "load_modules",
        "names": "COORDINATES EASINGS agreed counted error_line",
        "npz": "NpyFile joined_crc npz_names read_npz",
        "threads": (
            "PART_SECONDS THREADS_VARIABLE cpu_threads device_turn limit_threads owner_lock run_parallel run_parts"
        ),
    },
)
