"""Compile SPIR-V with Mesa's RADV for a GPU that need not be present. ``amd`` runs this file in a
separate process, with RADV_FORCE_FAMILY set.

Reads JSON from standard input:

    attributes   list of the number of components of each vertex attribute
    programs     list of programs; each is a list of SPIR-V modules in hexadecimal, with the entry
                 point main. One module is a compute program with storage buffers at the bindings 0
                 and 1. Two modules are a vertex and a fragment program with one float32 colour
                 output, a uniform buffer at binding 0 and textures at 1 to 3.

Writes a line of JSON: the driver, and for each program the statistics of its last stage by name.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import vulkan as vk

_STATISTICS = "VK_KHR_pipeline_executable_properties"
_FLAGS = vk.VK_PIPELINE_CREATE_CAPTURE_STATISTICS_BIT_KHR
_FLOATS = {
    2: vk.VK_FORMAT_R32G32_SFLOAT,
    3: vk.VK_FORMAT_R32G32B32_SFLOAT,
    4: vk.VK_FORMAT_R32G32B32A32_SFLOAT,
}


def compile_programs(
    programs: Sequence[Sequence[bytes]], attributes: Sequence[int]
) -> tuple[str, list[dict[str, int]]]:
    """Return the driver's name and version, and the integer statistics of each program."""
    application = vk.VkApplicationInfo(apiVersion=vk.VK_MAKE_VERSION(1, 2, 0))
    instance = vk.vkCreateInstance(vk.VkInstanceCreateInfo(pApplicationInfo=application), None)
    gpu = vk.vkEnumeratePhysicalDevices(instance)[0]
    driver = vk.VkPhysicalDeviceDriverProperties()
    vk.vkGetPhysicalDeviceProperties2(gpu, vk.VkPhysicalDeviceProperties2(pNext=driver))

    queue = vk.VkDeviceQueueCreateInfo(queueFamilyIndex=0, queueCount=1, pQueuePriorities=[1.0])
    device = vk.vkCreateDevice(
        gpu,
        vk.VkDeviceCreateInfo(
            pNext=vk.VkPhysicalDevicePipelineExecutablePropertiesFeaturesKHR(
                pipelineExecutableInfo=1
            ),
            pQueueCreateInfos=[queue],
            ppEnabledExtensionNames=[_STATISTICS],
        ),
        None,
    )
    pipelines = {1: _Compute(device).pipeline, 2: _Graphics(device, attributes).pipeline}
    result = [_statistics(device, pipelines[len(each)](each)) for each in programs]
    name, version = (
        vk.ffi.string(text).decode() for text in (driver.driverName, driver.driverInfo)
    )
    return f"{name} {version}", result


class _Compute:
    """A factory of pipelines for compute programs."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.layout = _layout(device, 2 * [vk.VK_DESCRIPTOR_TYPE_STORAGE_BUFFER])

    def pipeline(self, modules: Sequence[bytes]) -> Any:
        stage = _stage(self.device, vk.VK_SHADER_STAGE_COMPUTE_BIT, modules[0])
        create_info = vk.VkComputePipelineCreateInfo(flags=_FLAGS, stage=stage, layout=self.layout)
        return vk.vkCreateComputePipelines(self.device, None, 1, [create_info], None)[0]


class _Graphics:
    """A factory of pipelines for vertex and fragment programs."""

    def __init__(self, device: Any, attributes: Sequence[int]) -> None:
        self.device, self.attributes = device, attributes
        textures = 3 * [vk.VK_DESCRIPTOR_TYPE_COMBINED_IMAGE_SAMPLER]
        self.layout = _layout(device, [vk.VK_DESCRIPTOR_TYPE_UNIFORM_BUFFER, *textures])
        color = vk.VkAttachmentDescription(
            format=_FLOATS[4],
            samples=vk.VK_SAMPLE_COUNT_1_BIT,
            finalLayout=vk.VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL,
        )
        drawn = vk.VkAttachmentReference(layout=vk.VK_IMAGE_LAYOUT_COLOR_ATTACHMENT_OPTIMAL)
        subpass = vk.VkSubpassDescription(
            pipelineBindPoint=vk.VK_PIPELINE_BIND_POINT_GRAPHICS, pColorAttachments=[drawn]
        )
        self.render_pass = vk.vkCreateRenderPass(
            device, vk.VkRenderPassCreateInfo(pAttachments=[color], pSubpasses=[subpass]), None
        )

    def pipeline(self, modules: Sequence[bytes]) -> Any:
        kinds = vk.VK_SHADER_STAGE_VERTEX_BIT, vk.VK_SHADER_STAGE_FRAGMENT_BIT
        # Keep a reference: the array of stages is a copy that does not keep their modules alive.
        stages = [_stage(self.device, *each) for each in zip(kinds, modules, strict=True)]
        one_sample = vk.VkPipelineMultisampleStateCreateInfo(
            rasterizationSamples=vk.VK_SAMPLE_COUNT_1_BIT
        )
        bindings = [
            vk.VkVertexInputBindingDescription(binding=location, stride=4 * components)
            for location, components in enumerate(self.attributes)
        ]
        attributes = [
            vk.VkVertexInputAttributeDescription(location, location, _FLOATS[components], 0)
            for location, components in enumerate(self.attributes)
        ]
        area = vk.VkRect2D(vk.VkOffset2D(0, 0), vk.VkExtent2D(64, 64))
        create_info = vk.VkGraphicsPipelineCreateInfo(
            flags=_FLAGS,
            pStages=stages,
            pVertexInputState=vk.VkPipelineVertexInputStateCreateInfo(
                pVertexBindingDescriptions=bindings, pVertexAttributeDescriptions=attributes
            ),
            pInputAssemblyState=vk.VkPipelineInputAssemblyStateCreateInfo(
                topology=vk.VK_PRIMITIVE_TOPOLOGY_TRIANGLE_LIST
            ),
            pViewportState=vk.VkPipelineViewportStateCreateInfo(
                pViewports=[vk.VkViewport(0, 0, 64, 64, 0, 1)], pScissors=[area]
            ),
            pRasterizationState=vk.VkPipelineRasterizationStateCreateInfo(lineWidth=1),
            pMultisampleState=one_sample,
            pColorBlendState=vk.VkPipelineColorBlendStateCreateInfo(
                pAttachments=[vk.VkPipelineColorBlendAttachmentState(colorWriteMask=0b1111)]
            ),
            layout=self.layout,
            renderPass=self.render_pass,
        )
        return vk.vkCreateGraphicsPipelines(self.device, None, 1, [create_info], None)[0]


def _layout(device: Any, descriptors: Sequence[int]) -> Any:
    """Return a pipeline layout with descriptors of these types at the bindings from 0."""
    bindings = [
        vk.VkDescriptorSetLayoutBinding(
            binding=binding,
            descriptorType=kind,
            descriptorCount=1,
            stageFlags=vk.VK_SHADER_STAGE_ALL,
        )
        for binding, kind in enumerate(descriptors)
    ]
    descriptor_set = vk.vkCreateDescriptorSetLayout(
        device, vk.VkDescriptorSetLayoutCreateInfo(pBindings=bindings), None
    )
    return vk.vkCreatePipelineLayout(
        device, vk.VkPipelineLayoutCreateInfo(pSetLayouts=[descriptor_set]), None
    )


def _stage(device: Any, kind: int, code: bytes) -> Any:
    module = vk.vkCreateShaderModule(
        device, vk.VkShaderModuleCreateInfo(codeSize=len(code), pCode=code), None
    )
    return vk.VkPipelineShaderStageCreateInfo(stage=kind, module=module, pName="main")


def _statistics(device: Any, pipeline: Any) -> dict[str, int]:
    properties = vk.vkGetDeviceProcAddr(device, "vkGetPipelineExecutablePropertiesKHR")
    statistics = vk.vkGetDeviceProcAddr(device, "vkGetPipelineExecutableStatisticsKHR")
    stages = [each.stages for each in properties(device, vk.VkPipelineInfoKHR(pipeline=pipeline))]
    executable = vk.VkPipelineExecutableInfoKHR(
        pipeline=pipeline, executableIndex=stages.index(max(stages))
    )
    return {
        statistic.name: statistic.value.u64
        for statistic in statistics(device, executable)
        if statistic.format == vk.VK_PIPELINE_EXECUTABLE_STATISTIC_FORMAT_UINT64_KHR
    }


if __name__ == "__main__":
    given = json.load(sys.stdin)
    programs = [[bytes.fromhex(text) for text in modules] for modules in given["programs"]]
    print(json.dumps(compile_programs(programs, given["attributes"])))
