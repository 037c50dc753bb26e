"""Many frames, fits and evaluations: items of a job file, and the worker that makes them."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "engines.chunk_runner": "Chunk ChunkReport ChunkRunner RunJournal RunnerSettings",
        "items": "EvaluateItem FitItem FrameItem Item record_outputs",
        "job_file": "Fingerprints JobFile Missing write_jobs",
        "manifest": "Manifest Notes OutputFolder Part id_key merge_notes notes_of_chunk write_array",
        "plan": "foresee make_plan unpaid",
        "engines.processes": "Answer LocalHost ProcessEngine ray_session RayHost Share ThisProcess",
        "run": "Driver run_jobs RunProgress RunReport",
        "scheduler": "AIM LARGEST ChunkQueue Dispatcher",
        "engines.serving": "early_processes",
        "sweeps": "GivenSource RandomSource RandomViews write_sweep",
        "webdataset": "finish_folder pack_shard read_shard shard_holds shard_path shard_stage split_key staged_shards",
        "worker": "CHECKPOINTS MAX_DEFORMERS PARTS Worker",
    },
)
