"""The ground of `envs` and everything built on it: errors for people, files, and batches."""
