"""Numbers that compare: PSNR and SSIM (`quality`), the paper's IPSD (`ipsd`)."""
