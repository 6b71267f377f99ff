// step_onnx MODEL ARRAYS FRAMES OUT: simulates a scene with an ONNX file of hgn.export.
#include <onnxruntime_cxx_api.h>

#include <chrono>
#include <cmath>
#include <iostream>

#include "arrays.hpp"

int main(int count, char** words) try {
    if (count != 5) throw std::runtime_error("usage: step_onnx MODEL ARRAYS FRAMES OUT");
    const int frames = std::stoi(words[3]);
    Ort::Env environment(ORT_LOGGING_LEVEL_WARNING, "hgn");
    Ort::Session step(environment, words[1], Ort::SessionOptions{nullptr});

    auto arrays = read_arrays(words[2]);
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtDeviceAllocator, OrtMemTypeDefault);
    std::vector<Ort::Value> inputs;
    std::vector<const char*> names;
    const auto tensor = [&](Array& array) {
        auto& [name, shape, type, bytes] = array;
        const auto element = type == "<f4" ? ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT : ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64;
        return Ort::Value::CreateTensor(memory, bytes.data(), bytes.size(), shape.data(), shape.size(), element);
    };
    for (auto& array : arrays) {
        inputs.push_back(tensor(array));
        names.push_back(array.name.c_str());
    }
    const char* outputs[] = {"next_position", "next_velocity"};
    const int64_t particles = arrays[0].shape[0];
    std::vector<float> positions;
    const auto start = std::chrono::steady_clock::now();
    for (int frame = 0;; frame++) {
        const int64_t number = frame;
        const float* position = inputs[0].GetTensorData<float>();
        for (int64_t i = 0; i < 3 * particles; i++)
            if (!std::isfinite(position[i])) throw std::runtime_error("the simulation diverged at frame " + std::to_string(frame));
        positions.insert(positions.end(), position, position + 3 * particles);
        if (frame == frames - 1) break;
        std::memcpy(arrays[2].bytes.data(), &number, sizeof number);  // inputs[2] reads it there
        Array poses;
        for (size_t i = 0; i < arrays.size(); i++)
            if (arrays[i].name == "moving_pose") inputs[i] = tensor(poses = poses_at(arrays[i], frame));
        auto next = step.Run(Ort::RunOptions{nullptr}, names.data(), inputs.data(), inputs.size(), outputs, 2);
        inputs[0] = std::move(next[0]);
        inputs[1] = std::move(next[1]);
    }
    const std::chrono::duration<double, std::milli> passed = std::chrono::steady_clock::now() - start;
    std::cout << passed.count() / std::max(frames - 1, 1) << " ms a frame\n";
    write_positions(words[4], positions, frames, particles);
} catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << "\n";
    return 2;
}
