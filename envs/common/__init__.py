"""What `envs` and everything built on it stand on: errors for people, files, and batches."""
