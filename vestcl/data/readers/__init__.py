"""One reader per data set: KITTI, Cityscapes, Virtual KITTI, folders of images, videos."""
