"""Images, masks and label maps as files: NIfTI, NRRD, MetaImage and DICOM."""
