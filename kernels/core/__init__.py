"""Helpers of kernels: lanes of threads, entries of vectors."""
