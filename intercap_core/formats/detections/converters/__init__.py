"""Converters of other tools' and data sets' files into what the core's readers give.

- ``wholebody``: keypoints as JSON in COCO's manner (COCO-WholeBody, mmpose, AlphaPose)
- ``label_maps``: lists of class names (COCO and LVIS data sets, YOLO's YAML, plain text)
- ``mask_files``: masks as image files, one instance a file or several numbered in one
- ``data_sets``: person masks of the InterCap release; keypoints and masks of BEHAVE

They know the core's types (people, instances), the core's readers know none of them.
"""
