"""What is made of recorded runs: run again, and learnt from again. Pure."""
