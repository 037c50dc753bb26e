"""Work beside a session: jobs, and the files that pages send."""
