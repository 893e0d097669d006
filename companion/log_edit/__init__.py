"""What a log would hold had something gone wrong: faults put into recorded bytes afterwards."""
