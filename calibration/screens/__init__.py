"""Where screens and cameras stand: surveyed dots, boards, scans."""
