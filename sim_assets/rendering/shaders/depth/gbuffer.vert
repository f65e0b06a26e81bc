#version 450
// SPDX-License-Identifier: MIT
// Vertices to the camera frame (OpenGL: x right, y up, z back). SAPIEN binds these blocks by name and layout.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

layout(location = 0) out float outDepth;
layout(location = 1) out flat uint outEntity;

void main() {
  vec4 inCamera = cameraBuffer.viewMatrix * (objectTransformBuffer.modelMatrix * vec4(position, 1));
  outDepth = -inCamera.z;
  outEntity = objectDataBuffer.segmentation.y;
  gl_Position = cameraBuffer.projectionMatrix * inCamera;
}
