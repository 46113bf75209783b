"""The lab's files and jobs: runs in, tables and reports out."""
