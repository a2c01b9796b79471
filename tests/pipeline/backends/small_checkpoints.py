"""Small checkpoints of foundation models with random weights, in the format of `save_pretrained`."""

import json
from pathlib import Path

import pytest
import torch

NEEDS = "the extra is not installed (make extras)"
SIDE = 64
"""size of pictures of SAM 2, pixels"""


def library():
    """Import transformers and seed random weights, or skip the test if the extra is not installed."""
    transformers = pytest.importorskip("transformers", reason=NEEDS)
    torch.manual_seed(0)
    return transformers


def dinov2(folder: Path) -> Path:
    transformers = library()
    config = transformers.Dinov2Config(
        hidden_size=24, num_hidden_layers=2, num_attention_heads=2, patch_size=14, image_size=70
    )
    transformers.Dinov2Model(config).save_pretrained(folder)
    table = dict(
        image_mean=[0.4, 0.5, 0.6], image_std=[0.2, 0.3, 0.25], resample=3, size={"shortest_edge": 256}
    )
    (folder / "preprocessor_config.json").write_text(json.dumps(table))
    return folder


def sam2(folder: Path) -> Path:
    transformers = library()
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[SIDE, SIDE],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 4, 2, 2],
        global_attention_blocks=[3],
        window_positional_embedding_background_size=[4, 4],
    )
    sizes = [[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2]
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=sizes,
        fpn_hidden_size=128,
    )
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        image_size=SIDE,
        num_maskmem=3,
        max_object_pointers_in_encoder=4,
        prompt_encoder_config=dict(hidden_size=128, image_size=SIDE, patch_size=16),
        mask_decoder_config=dict(
            hidden_size=128, mlp_dim=32, num_hidden_layers=1, num_attention_heads=2, iou_head_hidden_dim=32
        ),
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
    )
    model = transformers.Sam2VideoModel(config)
    for part in model.parameters():  # as large as trained ones, so that the memory influences the masks
        if part.dim() > 1:
            torch.nn.init.normal_(part, std=1.5 / part[0].numel() ** 0.5)
    model.save_pretrained(folder)
    return folder


def grounding_dino(folder: Path) -> Path:
    transformers = library()
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "a", "cat", "dog"]
    (folder / "vocab.txt").write_text("\n".join(words))
    transformers.BertTokenizerFast(vocab={word: i for i, word in enumerate(words)}).save_pretrained(folder)
    backbone = transformers.SwinConfig(
        window_size=4,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        image_size=64,
        out_features=["stage2", "stage3", "stage4"],
    )
    text = transformers.BertConfig(
        vocab_size=len(words),
        hidden_size=8,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=8,
        max_position_embeddings=16,
    )
    config = transformers.GroundingDinoConfig(
        backbone_config=backbone,
        text_config=text,
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=4,
        decoder_attention_heads=4,
        encoder_ffn_dim=32,
        decoder_ffn_dim=32,
        num_queries=12,
        num_feature_levels=4,
        max_text_len=16,
        use_pretrained_backbone=False,
        disable_custom_kernels=True,
    )
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
        GroundingDinoImageProcessorPil,
    )

    GroundingDinoImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 100}).save_pretrained(folder)
    return folder


def depth_anything(folder: Path, kind: str) -> Path:
    """Depth Anything V2 with inverse depth (`relative`) or metric depth (`metric`)."""
    transformers = library()
    backbone = transformers.Dinov2Config(
        hidden_size=24,
        num_hidden_layers=4,
        num_attention_heads=2,
        patch_size=14,
        image_size=70,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=24,
        neck_hidden_sizes=[8, 8, 12, 12],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type=kind,
        max_depth=20 if kind == "metric" else 1,
    )
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    return folder


def depth_pro(folder: Path) -> Path:
    transformers = library()
    vit = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, patch_size=4, image_size=32
    )
    config = transformers.DepthProConfig(
        fusion_hidden_size=16,
        patch_size=32,
        initializer_range=0.1,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[16, 16],
        scaled_images_ratios=[0.25, 0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.5, 0.2],
        scaled_images_feature_dims=[16, 16, 16],
        use_fov_model=False,
        image_model_config=vit.to_dict(),
        patch_model_config=vit.to_dict(),
        fov_model_config=vit.to_dict(),
    )
    transformers.DepthProForDepthEstimation(config).save_pretrained(folder)
    return folder
