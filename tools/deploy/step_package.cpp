// step_package PACKAGE ARRAYS FRAMES OUT: simulates a scene with a package of hgn.export, compiled for the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/from_blob.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

#include <chrono>
#include <iostream>

#include "arrays.hpp"

int main(int count, char** words) try {
    if (count != 5) throw std::runtime_error("usage: step_package PACKAGE ARRAYS FRAMES OUT");
    const int frames = std::stoi(words[3]);
    c10::InferenceMode without_gradients;
    torch::inductor::AOTIModelPackageLoader step(words[1]);

    auto arrays = read_arrays(words[2]);
    std::vector<at::Tensor> inputs;
    const auto tensor = [](Array& array) {
        return at::from_blob(array.bytes.data(), array.shape, array.type == "<f4" ? at::kFloat : at::kLong);
    };
    for (auto& array : arrays) inputs.push_back(tensor(array));
    const int64_t particles = inputs[0].size(0);
    std::vector<float> positions;
    const auto start = std::chrono::steady_clock::now();
    for (int frame = 0;; frame++) {
        const int64_t number = frame;
        const auto position = inputs[0].contiguous();
        if (!position.isfinite().all().item<bool>())
            throw std::runtime_error("the simulation diverged at frame " + std::to_string(frame));
        positions.insert(positions.end(), position.data_ptr<float>(), position.data_ptr<float>() + 3 * particles);
        if (frame == frames - 1) break;
        std::memcpy(arrays[2].bytes.data(), &number, sizeof number);  // inputs[2] reads it there
        Array poses;
        for (size_t i = 0; i < arrays.size(); i++)
            if (arrays[i].name == "moving_pose") inputs[i] = tensor(poses = poses_at(arrays[i], frame));
        auto outputs = step.run(inputs);
        inputs[0] = outputs[0];
        inputs[1] = outputs[1];
    }
    const std::chrono::duration<double, std::milli> passed = std::chrono::steady_clock::now() - start;
    std::cout << passed.count() / std::max(frames - 1, 1) << " ms a frame\n";
    write_positions(words[4], positions, frames, particles);
} catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << "\n";
    return 2;
}
