"""What touches the machine: files, memory, threads, caches of libraries, the screen."""
