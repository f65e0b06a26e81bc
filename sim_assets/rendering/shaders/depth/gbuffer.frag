#version 450
// SPDX-License-Identifier: MIT
// One picture, `Surface`: (bits of the depth in metres as float32, number of the entity, 0, 0); 0 where nothing is.
// SAPIEN's `trivial` shader writes three pictures. This one is of integers because pictures of floats are blended with
// what was drawn before, which takes longer and costs the last digits.

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} materialBuffer;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;

struct PointLight {
  vec4 position;
  vec4 emission;
};

struct DirectionalLight {
  vec4 direction;
  vec4 emission;
};

struct SpotLight {
  vec4 position;
  vec4 direction;
  vec4 emission;
};

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  PointLight pointLights[10];
  SpotLight texturedLights[1];
} sceneBuffer;

layout(location = 0) in float inDepth;
layout(location = 1) in flat uint inEntity;

layout(location = 0) out uvec4 outSurface;

void main() {
  outSurface = uvec4(floatBitsToUint(inDepth), inEntity, 0, 0);
}
