"""mapfold beside software that it did not choose: other versions, programs, drivers and readers."""
