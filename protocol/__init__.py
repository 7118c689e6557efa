"""Step-synchronised co-simulation over two shared-memory buffers; the specification is README.md beside this."""
