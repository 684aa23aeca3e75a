"""Compiles compute shaders with Mesa's RADV for a GPU that is not there. ``amd`` runs this file as
a process of its own, with RADV_FORCE_FAMILY set; nothing here knows GLSL.

Reads a JSON list of SPIR-V modules in hexadecimal; each has the entry point main and the storage
buffers 0 and 1. Writes, as one line of JSON, the driver and the statistics of each module by name.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence

import vulkan as vk

_STATISTICS = "VK_KHR_pipeline_executable_properties"


def compile_modules(modules: Sequence[bytes]) -> tuple[str, list[dict[str, int]]]:
    """Return the driver's name and version, and the integer statistics of each module."""
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
    buffers = [
        vk.VkDescriptorSetLayoutBinding(
            binding=binding,
            descriptorType=vk.VK_DESCRIPTOR_TYPE_STORAGE_BUFFER,
            descriptorCount=1,
            stageFlags=vk.VK_SHADER_STAGE_COMPUTE_BIT,
        )
        for binding in (0, 1)
    ]
    descriptors = vk.vkCreateDescriptorSetLayout(
        device, vk.VkDescriptorSetLayoutCreateInfo(pBindings=buffers), None
    )
    layout = vk.vkCreatePipelineLayout(
        device, vk.VkPipelineLayoutCreateInfo(pSetLayouts=[descriptors]), None
    )
    statistics_of = vk.vkGetDeviceProcAddr(device, "vkGetPipelineExecutableStatisticsKHR")
    result = []
    for code in modules:
        module = vk.vkCreateShaderModule(
            device, vk.VkShaderModuleCreateInfo(codeSize=len(code), pCode=code), None
        )
        stage = vk.VkPipelineShaderStageCreateInfo(
            stage=vk.VK_SHADER_STAGE_COMPUTE_BIT, module=module, pName="main"
        )
        create_info = vk.VkComputePipelineCreateInfo(
            flags=vk.VK_PIPELINE_CREATE_CAPTURE_STATISTICS_BIT_KHR, stage=stage, layout=layout
        )
        pipeline = vk.vkCreateComputePipelines(device, None, 1, [create_info], None)[0]
        executable = vk.VkPipelineExecutableInfoKHR(pipeline=pipeline, executableIndex=0)
        result.append(
            {
                statistic.name: statistic.value.u64
                for statistic in statistics_of(device, executable)
                if statistic.format == vk.VK_PIPELINE_EXECUTABLE_STATISTIC_FORMAT_UINT64_KHR
            }
        )
    name, version = (
        vk.ffi.string(text).decode() for text in (driver.driverName, driver.driverInfo)
    )
    return f"{name} {version}", result


if __name__ == "__main__":
    print(json.dumps(compile_modules([bytes.fromhex(text) for text in json.load(sys.stdin)])))
