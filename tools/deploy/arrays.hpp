// NumPy's .npy files of version 1, little-endian, in C order: what a scene's arrays and the positions are kept in.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Array {
    std::string name;
    std::vector<int64_t> shape;
    std::string type;  // "<f4" or "<i8"
    std::vector<char> bytes;
};

inline Array read_array(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    char start[10];
    if (!file.read(start, sizeof start) || std::memcmp(start, "\x93NUMPY\x01", 7) != 0)
        throw std::runtime_error(path + " must be a .npy file of version 1; write it with python -m hgn.export arrays=");
    std::string header(static_cast<unsigned char>(start[8]) + 256 * static_cast<unsigned char>(start[9]), ' ');
    file.read(header.data(), header.size());
    Array array;
    array.type = header.substr(header.find("'descr': '") + 10, 3);
    if ((array.type != "<f4" && array.type != "<i8") || header.find("'fortran_order': False") == std::string::npos)
        throw std::runtime_error(path + " must hold float32 or int64 in C order, got " + header);
    size_t first = header.find('(') + 1;
    std::istringstream sizes(header.substr(first, header.find(')') - first));
    int64_t count = 1;
    for (std::string size; std::getline(sizes, size, ',');)
        if (size.find_first_not_of(' ') != std::string::npos) {
            array.shape.push_back(std::stoll(size));
            count *= array.shape.back();
        }
    array.bytes.resize(count * (array.type == "<f4" ? 4 : 8));
    if (!file.read(array.bytes.data(), array.bytes.size()) && !array.bytes.empty())
        throw std::runtime_error(path + " ends too early");
    return array;
}

inline void write_positions(const std::string& path, const std::vector<float>& values, int64_t frames, int64_t particles) {
    std::ostringstream text;
    text << "{'descr': '<f4', 'fortran_order': False, 'shape': (" << frames << ", " << particles << ", 3), }";
    std::string header = text.str();
    header.append(63 - (header.size() + 10) % 64, ' ').push_back('\n');
    std::ofstream file(path, std::ios::binary);
    file.write("\x93NUMPY\x01\x00", 8);
    file.put(header.size() % 256).put(header.size() / 256) << header;
    file.write(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(float));
    if (!file.flush()) throw std::runtime_error(path + " could not be written");
}

// Order and names of a step's inputs; the first two are replaced by its two outputs, and the third is increased by 1.
inline const std::vector<std::string> INPUTS = {
    "position",      "velocity",        "frame", "material", "domain_size", "gravity",
    "obstacle_cell", "obstacle_normal", "obstacle_triangle"};
// The inputs that follow if the network has them: friction, parameters of materials, elastic bodies, moving obstacles.
inline const std::vector<std::string> OWN_INPUTS = {
    "wall_friction", "obstacle_friction", "parameters",     "rest_position",  "rest_neighbour",
    "moving_pose",   "moving_cell",       "moving_surface", "moving_triangle"};

inline std::vector<Array> read_arrays(const std::string& folder) {
    std::vector<Array> arrays;
    const auto read = [&](const std::string& name, bool required) {
        const std::string path = folder + "/" + name + ".npy";
        if (!required && !std::filesystem::exists(path)) return;
        arrays.push_back(read_array(path));
        arrays.back().name = name;
    };
    for (const auto& name : INPUTS) read(name, true);
    for (const auto& name : OWN_INPUTS) read(name, false);
    return arrays;
}

// The poses of moving obstacles in a frame and the next one, of those in all frames. At last the obstacles rest.
inline Array poses_at(const Array& poses, int64_t frame) {
    const int64_t rows = poses.shape[0], size = poses.bytes.size() / rows;
    const auto first = poses.bytes.begin() + size * std::min(frame, rows - 2);
    Array two{poses.name, poses.shape, poses.type, {first, first + 2 * size}};
    two.shape[0] = 2;
    return two;
}
